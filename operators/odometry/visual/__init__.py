"""Odometry from cameras: what visual and visual-inertial odometry share, and stereo or RGB-D odometry."""
