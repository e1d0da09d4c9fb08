"""The optimizer of a running graph."""
