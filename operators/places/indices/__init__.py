"""Nearest descriptors among many: bits by an inverted multi-index, numbers by FLANN or HNSW, both exactly."""
