"""Where streams begin: recordings."""
