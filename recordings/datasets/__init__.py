"""Public data sets and other recordings, rewritten as MCAP."""
