"""Edges that measure one pose from another: odometry, wheels, registrations, loops, within and across missions."""

from __future__ import annotations

import gtsam

from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.messages.sensors import IntArray


def between(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return a factor per edge; several between the same two poses are as many factors.

    A direction of infinite variance has no information at all: z, roll and pitch of wheels, for instance.
    """
    edges = map_.edges
    noise_of.prepare(edges.covariance[rows])
    ends = zip(
        rows.tolist(), edges.vertex_a[rows].tolist(), edges.vertex_b[rows].tolist(), strict=True
    )
    return {
        row: gtsam.BetweenFactorPose3(
            a, b, gtsam.Pose3(edges.T_a_b[row]), noise_of(edges.covariance[row])
        )
        for row, a, b in ends
    }
