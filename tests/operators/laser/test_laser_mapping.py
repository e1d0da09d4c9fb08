"""From the scans of W-2D to a map: odometry, loops and optimizer."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from mapstream.operators.laser.laser_loops import LaserLoops, LaserLoopsConfig
from mapstream.operators.laser.laser_odometry import LaserOdometry, LaserOdometryConfig
from mapstream.operators.laser.planar import lifted
from mapstream.operators.submaps.keyframes import Keyframes, KeyframesConfig
from mapstream.operators.submaps.submap_builder import SubmapBuilder, SubmapBuilderConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.planar_laser import PlanarLaserConfig
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopReport,
    Odometry,
    PointCloud,
    Submap,
)
from mapstream.streams.messages.sensors import LaserScan2D, WheelOdometry
from mapstream.streams.trajectory import Trajectory
from tests.operators.laser.plane_worlds import CORRIDOR, seen_from
from tests.operators.test_lidar_mapping import LOOPS, errors_m, map_of

pytestmark = pytest.mark.anyio
SECOND_NS = 10**9


@cache
def recording() -> dict[str, list[Any]]:
    """Return the messages of a small W-2D by topic."""
    laser = PlanarLaserConfig(beams=181, rate_hz=4)
    topics: dict[str, list[Any]] = {}
    for record in w_2d(W2dConfig(width_m=14.0, visits=False, laser=laser), seed=1).records:
        topics.setdefault(record.topic, []).append(record.message)
    return topics


def truth() -> Trajectory:
    messages: list[Odometry] = recording()["/truth"]
    return Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in messages]),
        poses=np.array([m.T_odom_base.matrix for m in messages]),
    )


async def submaps_of(inputs: dict[str, list[Any]]) -> list[Submap]:
    tracked = await run_operator(
        LaserOdometry(LaserOdometryConfig()), laser=inputs["laser"], wheels=inputs["wheels"]
    )
    keyframes = await run_operator(
        Keyframes(KeyframesConfig(distance_m=0.5)),
        odometry=tracked["odometry"],
        clouds=tracked["clouds"],
    )
    builder = SubmapBuilder(SubmapBuilderConfig(length_m=5.0))
    return (await run_operator(builder, keyframes=keyframes["keyframes"]))["submaps"]


@pytest.mark.slow
async def test_I15_two_laps_close_with_scans_alone() -> None:
    """Each pose is within 5 cm; every loop spans more than 20 keyframes and may be switched off."""
    topics = recording()
    submaps = await submaps_of({"laser": topics["/scan"], "wheels": []})

    maps = await map_of(submaps, LOOPS, LaserLoops(LaserLoopsConfig(spacing_m=3.0)))

    edges = maps[-1].edges
    loops = np.flatnonzero(edges.kind == "loop")
    assert len(loops) >= 5
    assert (edges.switch[loops] >= 0.5).all()
    assert (np.abs(edges.vertex_b[loops] - edges.vertex_a[loops]) > 20).all()
    assert errors_m(maps[-1], truth()).max() < 0.05


async def test_I15_every_candidate_has_a_verdict() -> None:
    """Two passes along one way: what is compared is reported, and keyframes just left are no places seen before."""
    way = [np.array([0.1 * min(k, 60 - k), 0.0, 0.02 * k]) for k in range(61)]
    rng = np.random.default_rng(5)
    keyframes = [keyframe(k, pose, rng) for k, pose in enumerate(way)]
    builder = SubmapBuilder(SubmapBuilderConfig(length_m=3.0))
    submaps = (await run_operator(builder, keyframes=keyframes))["submaps"]
    config = LaserLoopsConfig(min_path_m=2.0)

    out = await run_operator(LaserLoops(config), submaps=submaps)

    reports: list[LoopReport] = out["loops"]
    candidates = [candidate for report in reports for candidate in report.candidates]
    edges = [edge for report in reports for edge in report.edges]
    assert len(reports) == len(submaps)
    assert [c.verdict for c in candidates].count("accepted") == len(edges) > 0
    for edge in edges:
        a, b = edge.stamp_a_ns // SECOND_NS, edge.stamp_b_ns // SECOND_NS
        assert b - a > 20
        assert edge.is_switchable
        expected = lifted(way[a]).inverse() @ lifted(way[b])
        assert np.linalg.norm((expected.inverse() @ edge.T_a_b).log()) < 0.02


def keyframe(k: int, pose: FloatArray, rng: np.random.Generator) -> Keyframe:
    """Return what a laser saw of the room, with the odometry exact."""
    points = np.pad(seen_from(pose, rng=rng), ((0, 0), (0, 1)))
    stamp_ns = k * SECOND_NS
    odometry = Odometry(
        stamp_ns=stamp_ns,
        T_odom_base=lifted(pose),
        covariance=None if k == 0 else 1e-4 * np.eye(6),
    )
    cloud = PointCloud(stamp_ns=stamp_ns, points=points.astype(np.float32))
    return Keyframe(stamp_ns=stamp_ns, odometry=odometry, cloud=cloud)


def corridor_scans(num: int, step_m: float) -> list[LaserScan2D]:
    """Return scans of a bare corridor, each `step_m` further along it."""
    rng = np.random.default_rng(3)
    scans = []
    for k in range(num):
        points = seen_from(np.array([k * step_m, 0.0, 0.0]), CORRIDOR, rng)
        beams = np.round((np.arctan2(points[:, 1], points[:, 0]) + 2) / 4 * 180).astype(int)
        ranges = np.full(181, np.nan)
        ranges[beams] = np.linalg.norm(points, axis=1)
        scans.append(laser_scan(k * SECOND_NS // 5, ranges))
    return scans


def laser_scan(stamp_ns: int, ranges: FloatArray) -> LaserScan2D:
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=ranges.astype(np.float32),
        angle_min_rad=-2.0,
        angle_step_rad=4 / 180,
        range_min_m=0.05,
        range_max_m=20.0,
    )


async def test_wheels_lead_along_a_bare_corridor() -> None:
    """Scans say nothing of the way along it; the wheels do, though their heading is wrong."""
    scans = corridor_scans(30, step_m=0.1)
    wheels = [
        WheelOdometry(
            stamp_ns=scan.stamp_ns,
            T_odom_base=SE3.from_rotation(so3_exp([0, 0, 0.002 * k]), [0.1 * k, 0.0, 0.0]),
        )
        for k, scan in enumerate(scans)
    ]

    out = await run_operator(LaserOdometry(LaserOdometryConfig()), laser=scans, wheels=wheels)

    end = out["odometry"][-1].T_odom_base
    np.testing.assert_allclose(end.t, [2.9, 0.0, 0.0], atol=0.05)
    assert end.angle_rad < 0.01
    sigmas = np.sqrt(np.diagonal(out["odometry"][-1].covariance))
    assert sigmas[3] > 3 * sigmas[4]


async def test_scans_that_show_nothing_are_lost_without_wheels() -> None:
    """A covered laser is no motion that was measured; behind it mapping goes on."""
    scans = corridor_scans(9, step_m=0.0)
    scans[4:6] = [laser_scan(scan.stamp_ns, np.full(181, np.nan)) for scan in scans[4:6]]

    out = await run_operator(LaserOdometry(LaserOdometryConfig()), laser=scans)

    assert [odometry.is_lost for odometry in out["odometry"]] == [False] * 4 + [True] * 2 + [
        False
    ] * 3
    assert [cloud.stamp_ns for cloud in out["clouds"]] == [scan.stamp_ns for scan in scans]
    assert len(out["clouds"][4].points) == 0


async def test_another_odometry_may_lead_instead_of_wheels() -> None:
    scans = corridor_scans(10, step_m=0.2)
    odometry = [
        Odometry(
            stamp_ns=k * SECOND_NS // 10,
            T_odom_base=SE3.from_rotation(np.eye(3), [0.1 * k, 0.0, 0.0]),
        )
        for k in range(20)
    ]

    out = await run_operator(LaserOdometry(LaserOdometryConfig()), laser=scans, odometry=odometry)

    np.testing.assert_allclose(out["odometry"][-1].T_odom_base.t, [1.8, 0.0, 0.0], atol=0.05)
