"""Kinds of edges that measure a transform between two vertices. Others there may be, of plugins too."""

from __future__ import annotations

MOTION_KINDS = ("odometry", "wheel", "registration", "motion_model")  # of a robot, by itself
RELATIVE_KINDS = (*MOTION_KINDS, "loop")
