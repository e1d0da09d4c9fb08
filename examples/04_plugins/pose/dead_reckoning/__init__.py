"""A pose source for mapstream: the robot's own odometry, with an uncertainty."""
