"""Where streams end: in files."""
