"""Walls that a planar laser and a depth camera on one robot both see."""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from mapstream.operators.laser.laser_lines import LaserLines, LaserLinesConfig
from mapstream.operators.planes.plane_landmarks import PlaneLandmarks, PlaneLandmarksConfig
from mapstream.operators.planes.plane_segmentation import (
    PlaneSegmentation,
    PlaneSegmentationConfig,
)
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame, LaserScan2D
from mapstream.streams.trajectory import Trajectory

ROBOT: dict[str, Any] = {
    "width_m": 14.0,
    "laps": 0.25,
    "wheels_hz": 1.0,
    "laser": {"rate_hz": 4.0},
    "depth": {"columns": 160, "rows": 120, "rate_hz": 2.0},
}


@pytest.mark.slow
@pytest.mark.anyio
async def test_N5_a_wall_that_both_see_is_one_landmark() -> None:
    """Along a corridor, into rooms: landmarks that are upright have measurements of both sensors, and no two are one wall."""
    messages = [record.message for record in w_2d(W2dConfig.model_validate(ROBOT), 0).records]
    scans = [m for m in messages if isinstance(m, LaserScan2D)]
    frames = [m for m in messages if isinstance(m, CameraFrame)]
    odometry = [m for m in messages if isinstance(m, Odometry)]
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in odometry]),
        poses=np.array([m.T_odom_base.matrix for m in odometry]),
    )
    lines = await run_operator(LaserLines(LaserLinesConfig()), laser=scans, odometry=odometry)
    config = PlaneSegmentationConfig(min_pixels=700, window_px=7)
    planes = await run_operator(PlaneSegmentation(config), frames=frames)
    both = PlaneLandmarksConfig(inputs=("planes", "lines"))
    out = await run_operator(
        PlaneLandmarks(both),
        config=both,
        planes=planes["planes"],
        lines=lines["planes"],
        odometry=odometry,
    )

    sources, places = defaultdict(set), defaultdict(list)
    constraints: list[Constraint] = out["constraints"]
    name_of = _names(constraints)
    for constraint in constraints:
        assert constraint.landmark is not None
        name = name_of[constraint.landmark.name]
        T = way.at(constraint.stamp_ns)[0] @ constraint.T_a_b.matrix
        if abs(T[2, 2]) < 0.1:  # no floor
            sources[name].add(constraint.source.split()[-1])
            places[name].append(T)
    shared = [name for name, seen in sources.items() if len(seen) == 2]
    by_camera = [name for name, seen in sources.items() if "depth" in seen]

    assert len(shared) >= 5
    assert len(shared) >= 0.7 * len(by_camera)  # small things end below or beside the laser
    for name in shared:
        normals = np.array([T[:3, 2] for T in places[name]])
        assert (normals @ normals[0]).min() > np.cos(np.deg2rad(10))
    assert not [pair for pair in combinations(sources, 2) if _are_one(*(places[n] for n in pair))]


def _names(constraints: list[Constraint]) -> dict[str, str]:
    """Return the name that each landmark has in the end: one measurement of two says that they are one."""
    measured, name_of = dict[tuple[int, bytes], str](), dict[str, str]()
    for constraint in constraints:
        assert constraint.landmark is not None
        name = constraint.landmark.name
        key = (constraint.stamp_ns, constraint.T_a_b.matrix.tobytes())
        older = measured.setdefault(key, name)
        name_of[name] = name_of.get(older, older)
    return name_of


def _are_one(a: list[FloatArray], b: list[FloatArray]) -> bool:
    """Return whether two landmarks were measured at one spot of one wall."""
    for T in a:
        for other in b:
            is_parallel = T[:3, 2] @ other[:3, 2] > np.cos(np.deg2rad(5))
            gap = other[:2, 3] - T[:2, 3]
            if is_parallel and abs(gap @ T[:2, 2]) < 0.05 and np.linalg.norm(gap) < 0.3:
                return True
    return False
