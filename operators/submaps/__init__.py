"""From odometry to keyframes, and from keyframes to submaps."""
