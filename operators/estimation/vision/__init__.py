"""Bundle adjustment: what cameras and other sensors saw of points, as residuals of the map's problem."""
