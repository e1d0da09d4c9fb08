"""LiDAR scans as images, and keypoints with 3D points that are found in them."""
