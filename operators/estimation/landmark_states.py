"""Landmarks between the map's table, where each is fixed to a vertex, and the problem, where it is in the map."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam

from mapstream.operators.estimation.factors import planes
from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.estimation.keys import key_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert, quat_xyzw_from_rotation


def insert_landmarks(map_: Map, rows: IntArray, values: Any) -> None:  # noqa: ANN401
    """Put landmarks into gtsam's values, each as the variable of its shape."""
    poses = map_.T_map_landmark(rows)
    for row, pose in zip(rows.tolist(), poses, strict=True):
        key, shape = key_of("landmark", row), shape_of(map_.landmarks.kind[row])
        if shape == "pose":
            values.insert(key, gtsam.Pose3(pose))
        elif shape == "plane":
            values.insert(key, gtsam.OrientedPlane3(planes.coefficients(pose)))
        elif shape == "point2d":
            values.insert(key, pose[:2, 3])
        else:
            values.insertPoint3(key, pose[:3, 3])


def with_landmarks(map_: Map, before: Map, rows: IntArray, values: Any) -> Map:  # noqa: ANN401
    """Return the map with landmarks from gtsam's values, each fixed to the vertex that it had.

    Args:
        map_: With the new poses of its vertices.
        before: The map that the values came from.
        rows: The landmarks to take.
        values: Of these landmarks.
    """
    if not len(rows):
        return map_
    p_base, quat = map_.landmarks.p_base.copy(), map_.landmarks.quat_base_xyzw.copy()
    was = before.T_map_landmark(rows)
    T_base_map = invert(map_.T_map_base(map_.landmarks.vertex[rows]))
    for at, row in enumerate(rows.tolist()):
        shape = shape_of(map_.landmarks.kind[row])
        T_base_landmark = T_base_map[at] @ _place(values, key_of("landmark", row), shape, was[at])
        if shape == "point2d":  # along the line, to where the base's x-y plane cuts it
            up = T_base_map[at, :3, 2]
            T_base_landmark[:3, 3] -= T_base_landmark[2, 3] / up[2] * up
        p_base[row] = T_base_landmark[:3, 3]
        if shape in ("pose", "plane"):
            quat[row] = quat_xyzw_from_rotation(T_base_landmark[:3, :3])
    landmarks = replace(map_.landmarks, p_base=p_base, quat_base_xyzw=quat)
    return replace(map_, landmarks=landmarks)


def _place(values: Any, key: int, shape: str, was: FloatArray) -> FloatArray:  # noqa: ANN401
    """Return T_map_landmark (4, 4), as near to where it was as the variable leaves open."""
    place = was.copy()
    if shape == "pose":
        place = values.atPose3(key).matrix()
    elif shape == "plane":
        place = planes.pose_on(values.atOrientedPlane3(key).planeCoefficients(), was)
    elif shape == "point2d":
        place[:2, 3] = values.atPoint2(key)
    else:
        place[:3, 3] = values.atPoint3(key)
    return place
