"""Work on LiDAR points: sampling, motion compensation, registration, loop closure."""
