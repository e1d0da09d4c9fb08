"""Which measurements are false."""
