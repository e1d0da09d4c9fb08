"""Synthetic recordings: worlds of triangles, driven through and seen by simulated sensors."""
