"""Planes: found in depth and in clouds, followed as landmarks, and recognised in a map."""
