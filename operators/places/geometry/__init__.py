"""Where a robot must be, from what it sees of a map: minimal solvers, consensus over all cameras, refinement."""
