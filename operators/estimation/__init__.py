"""The one door to gtsam: symbols, noise, factors, and the incremental and the batch solver."""
