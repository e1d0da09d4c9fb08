"""Satellite positioning: from the ellipsoid to planes in which maps are made."""
