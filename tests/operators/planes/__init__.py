"""Planes: found, followed, recognised."""
