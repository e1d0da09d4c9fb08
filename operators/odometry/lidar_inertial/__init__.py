"""Odometry from a LiDAR and an IMU: an iterated Kalman filter on a local map of points."""
