"""Odometry: how the base moved from message to message."""
