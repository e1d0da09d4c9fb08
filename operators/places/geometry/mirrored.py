"""The second pose from which points of one plane look nearly the same: few sightings of a wall may fit both.

Small or far, a plane that leans one way looks like one that leans the other way. Source: Schweighofer and Pinz,
Robust Pose Estimation from a Planar Target, PAMI 2006, section 3.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.places.geometry.sightings import Sightings
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert


def mirrored(sightings: Sightings, T_map_base: FloatArray) -> FloatArray:
    """Return the pose (4, 4) from which the plane through the sighted points leans the other way.

    The points keep their middle, and their depths around it change sign, along the line of sight. For points of a
    plane that is a rotation about the middle, by twice the angle between the plane's normal and that line.

    Args:
        sightings: That agree with a pose; at least three.
        T_map_base: That pose (4, 4).
    """
    T_base_map = invert(T_map_base)
    points = sightings.points_map @ T_base_map[:3, :3].T + T_base_map[:3, 3]
    eyes = np.array([sensor.T_base_sensor.t for sensor in sightings.sensors])
    middle = points.mean(axis=0)
    sight = middle - eyes[sightings.sensor].mean(axis=0)
    sight /= max(float(np.linalg.norm(sight)), 1e-12)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    turned = np.eye(4)
    turned[:3, :3] = _reflection(sight) @ _reflection(normal)
    turned[:3, 3] = middle - turned[:3, :3] @ middle
    return invert(turned @ T_base_map)


def _reflection(normal: FloatArray) -> FloatArray:
    return np.eye(3) - 2 * np.outer(normal, normal)
