"""Planar lasers: motion by matching scans, loops, wall lines, occupancy grids and places in them."""
