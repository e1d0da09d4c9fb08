"""Loops closed by objects that were seen before."""
