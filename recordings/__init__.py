"""What outlives a run: recordings, trajectories, maps."""
