"""Odometry from the shape of what a colour and depth camera sees."""
