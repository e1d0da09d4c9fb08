"""Dense maps: truncated signed distances in sparse blocks, their surfaces, distance fields, and depth."""
