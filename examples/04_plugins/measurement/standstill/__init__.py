"""A measurement for mapstream: the robot stood still."""
