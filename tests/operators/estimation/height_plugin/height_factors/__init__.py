"""A barometer says how much higher one pose is than another, whatever lies between."""

from __future__ import annotations

import json
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray


def height_differences(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return a factor for each edge; its payload has "up_m", its covariance the variance in the last place."""
    edges = map_.edges
    factors = {}
    for row in rows.tolist():
        up_m = json.loads(edges.payload[row])["up_m"]
        ends = [int(edges.vertex_a[row]), int(edges.vertex_b[row])]
        noise = noise_of(edges.covariance[row, 5:, 5:])
        factors[row] = gtsam.CustomFactor(noise, ends, _residual(up_m))
    return factors


def _residual(up_m: float) -> Any:  # noqa: ANN401  # gtsam calls it
    def residual(factor: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:  # noqa: ANN401
        a, b = (values.atPose3(key) for key in factor.keys())  # noqa: SIM118
        if jacobians is not None:
            for at, (pose, sign) in enumerate(((a, -1.0), (b, 1.0))):
                by_pose = np.zeros((1, 6), order="F")
                by_pose[0, 3:] = sign * pose.rotation().matrix()[2]
                jacobians[at] = by_pose
        return np.array([b.translation()[2] - a.translation()[2] - up_m])

    return residual
