"""Edges that measure one pose from another: odometry, wheels, registrations, loops, within and across missions."""

from __future__ import annotations

import gtsam

from mapstream.operators.estimation.factors.edge_ends import require_ends
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray


def between(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return a factor per edge; several between the same two poses are as many factors.

    A direction of infinite variance has no information at all: z, roll and pitch of wheels, for instance.

    Raises:
        EstimationError: If a vertex is missing, or a covariance is not one.
    """
    require_ends(map_, rows, "vertex_a", "vertex_b")
    edges = map_.edges
    between_of, pose_of = gtsam.BetweenFactorPose3, gtsam.Pose3
    columns = (
        rows.tolist(),
        edges.vertex_a[rows].tolist(),
        edges.vertex_b[rows].tolist(),
        edges.T_a_b[rows],
        noise_of.of_all(edges.covariance[rows]),
    )
    return {
        row: between_of(a, b, pose_of(T_a_b), noise)
        for row, a, b, T_a_b, noise in zip(*columns, strict=True)
    }
