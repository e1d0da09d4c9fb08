"""The base frame is a choice: another one gives the same trajectory, seen from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.box_room import box_room, drive_through
from mapstream.streams.geometry import SE3

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("make", "tolerance"),
    [
        (lambda: KissOdometry(KissOdometryConfig(voxel_size_m=0.5)), 1e-6),
        (lambda: GicpOdometry(GicpOdometryConfig()), 5e-3),  # its voxels lie along the base's axes
    ],
    ids=["kiss", "gicp"],
)
async def test_G1_another_base_gives_the_same_trajectory(
    make: Callable[[], Any], tolerance: float
) -> None:
    scans = drive_through(box_room(seed=2), num_scans=6, speed_mps=1.0, turn_radps=0.3).scans
    T_base_sensor = SE3.exp([0.1, -0.2, 1.0, 0.3, 0.1, 0.9])
    T_other_base = SE3.exp([0.0, 0.3, -0.7, -1.0, 2.0, 0.2])

    def mounted(T: SE3) -> list[Any]:
        return [replace(scan, T_base_sensor=T) for scan in scans]

    one = (await run_operator(make(), scans=mounted(T_base_sensor)))["odometry"]
    other = (await run_operator(make(), scans=mounted(T_other_base @ T_base_sensor)))["odometry"]

    for a, b in zip(one, other, strict=True):
        expected = T_other_base @ a.T_odom_base @ T_other_base.inverse()
        np.testing.assert_allclose(b.T_odom_base.matrix, expected.matrix, atol=tolerance)
        assert a.stamp_ns == b.stamp_ns


async def test_G6_a_lidar_alone_gives_poses_at_the_ends_of_its_scans() -> None:
    scans = drive_through(box_room(seed=2), num_scans=4).scans

    sent = await run_operator(KissOdometry(KissOdometryConfig()), scans=scans)

    assert [o.stamp_ns for o in sent["odometry"]] == [scan.end_ns for scan in scans]
    assert [c.stamp_ns for c in sent["clouds"]] == [scan.end_ns for scan in scans]
