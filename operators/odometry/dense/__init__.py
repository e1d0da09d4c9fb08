"""Odometry by comparing whole images of colour and depth."""
