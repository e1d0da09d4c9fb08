"""What images show: keypoints, tracks."""
