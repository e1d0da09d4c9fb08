"""Landmarks of a map: made from tracks, located, judged, merged and removed."""
