"""Edges that measure one pose in an outer frame."""

from __future__ import annotations

import gtsam

from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.messages.sensors import IntArray


def pose(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return a factor per edge on all six directions."""
    edges = map_.edges
    return {
        row: gtsam.PriorFactorPose3(
            vertex, gtsam.Pose3(edges.T_a_b[row]), noise_of(edges.covariance[row])
        )
        for row, vertex in zip(rows.tolist(), edges.vertex_a[rows].tolist(), strict=True)
    }
