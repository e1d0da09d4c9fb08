"""From compressed to raw."""
