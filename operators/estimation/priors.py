"""Weak priors on what measurements alone may leave open, so that a problem never has too few of them.

Biases begin near zero, extrinsics near where they were measured, outer frames anywhere, and walls that were seen
as lines stand upright to the laser that saw them.
Each is so weak that a handful of measurements outweighs it.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.inertial import parameters_of
from mapstream.operators.estimation.factors.mounts import mounts, place_prior
from mapstream.operators.estimation.factors.planes import coefficients
from mapstream.operators.estimation.keys import key_of, rows_by_variable
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.outer_frames import starting_frames
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray

_TILT_SIGMA_RAD = 0.3  # of a wall
_FRAME_SIGMAS = np.repeat([10.0, 1e5], 3)  # [rad, m]


def prior_factors(map_: Map, factors: Mapping[int, Factor]) -> dict[int, Factor]:
    """Return priors by the key of their variable, for factors by row of edges that are new to a problem.

    A bias gets one where a chain of IMU edges begins; along the chain the random walk holds the others.
    """
    keys = {key for factor in factors.values() for key in factor.keys()}  # noqa: SIM118
    rows = rows_by_variable(keys)
    nothing = np.zeros(0, np.int64)
    return {
        **_of_biases(map_, rows.get("bias", nothing)),
        **_of_mounts(map_, rows.get("extrinsics", nothing)),
        **_of_frames(map_, rows.get("frame", nothing)),
        **_of_walls(map_, np.array(sorted(factors), np.int64)),
    }


def _of_biases(map_: Map, vertices: IntArray) -> dict[int, Factor]:
    inertial = map_.edges_of("imu")
    first = np.setdiff1d(vertices, map_.edges.vertex_b[inertial])
    priors = {}
    for vertex in first.tolist():
        parameters = parameters_of(map_, int(map_.vertices.mission[vertex]))
        sigmas = (parameters.accel_bias_sigma_mps2, parameters.gyro_bias_sigma_radps)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigmas, 3))
        key = key_of("bias", vertex)
        priors[key] = gtsam.PriorFactorConstantBias(key, gtsam.imuBias.ConstantBias(), noise)
    return priors


def _of_mounts(map_: Map, rows: IntArray) -> dict[int, Factor]:
    found = mounts(map_) if len(rows) else []
    priors = {}
    for row in rows.tolist():
        T_base_sensor, sigmas = place_prior(found[row])
        key, noise = key_of("extrinsics", row), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        priors[key] = gtsam.PriorFactorPose3(key, gtsam.Pose3(T_base_sensor), noise)
    return priors


def _of_frames(map_: Map, rows: IntArray) -> dict[int, Factor]:
    noise = gtsam.noiseModel.Diagonal.Sigmas(_FRAME_SIGMAS)
    keys = [key_of("frame", row) for row in rows.tolist()]
    starts = starting_frames(map_, rows)
    return {
        key: gtsam.PriorFactorPose3(key, gtsam.Pose3(start), noise)
        for key, start in zip(keys, starts, strict=True)
    }


def _of_walls(map_: Map, rows: IntArray) -> dict[int, Factor]:
    """Return priors on the tilt of planes that edges see as lines, which leave it open."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, _TILT_SIGMA_RAD)
    edges = map_.edges
    along, across = edges.covariance[rows, 0, 0], edges.covariance[rows, 1, 1]
    is_line = (edges.kind[rows] == "plane") & np.isinf(along) & np.isfinite(across)
    walls = np.unique(edges.landmark_a[rows[is_line]])
    known = coefficients(map_.T_map_landmark(walls))
    return {
        (key := key_of("landmark", row)): gtsam.OrientedPlane3DirectionPrior(key, plane, noise)
        for row, plane in zip(walls.tolist(), known, strict=True)
    }
