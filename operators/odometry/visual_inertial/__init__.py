"""Odometry from one or more cameras and an IMU."""
