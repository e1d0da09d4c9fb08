from __future__ import annotations

from itertools import pairwise
from typing import Any

import anyio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.submaps.keyframes import Keyframes, KeyframesConfig
from mapstream.operators.submaps.submap_builder import SubmapBuilder, SubmapBuilderConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Keyframe, Odometry, PointCloud

STEP_NS = 100_000_000


def straight(num: int, step_m: float = 0.1) -> list[Odometry]:
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    return [
        Odometry(
            stamp_ns=i * STEP_NS,
            T_odom_base=SE3.exp([0, 0, 0, i * step_m, 0, 0]),
            covariance=covariance,
        )
        for i in range(num)
    ]


def chosen(
    config: KeyframesConfig, odometry: list[Odometry], clouds: list[PointCloud] | None = None
) -> list[Keyframe]:
    more: dict[str, Any] = {"odometry": odometry} | ({"clouds": clouds} if clouds else {})
    return anyio.run(lambda: run_operator(Keyframes(config), **more))["keyframes"]


def test_G7_a_keyframe_every_metre_and_both_ends() -> None:
    frames = chosen(KeyframesConfig(distance_m=1.0), straight(25))

    assert [f.stamp_ns // STEP_NS for f in frames] == [0, 10, 20, 24]


def test_G7_turning_on_the_spot_gives_keyframes() -> None:
    turns = [
        Odometry(stamp_ns=i * STEP_NS, T_odom_base=SE3.exp([0, 0, 0.1 * i, 0, 0, 0]))
        for i in range(11)
    ]

    frames = chosen(KeyframesConfig(rotation_rad=0.49), turns)

    assert [f.stamp_ns // STEP_NS for f in frames] == [0, 5, 10]


def test_B16_a_period_gives_keyframes_at_a_standstill() -> None:
    frames = chosen(KeyframesConfig(period_s=1.0), straight(21, step_m=0.0))

    assert [f.stamp_ns // STEP_NS for f in frames] == [0, 10, 20]


def test_G3_covariance_grows_with_the_interval() -> None:
    """Ten steps of 1 cm along x give a variance of ten times one step; across x the turns add to it."""
    frames = chosen(KeyframesConfig(distance_m=1.0), straight(11))

    covariance = frames[1].odometry.covariance
    assert covariance is not None
    assert covariance[3, 3] == pytest.approx(10 * 1e-4)
    assert covariance[4, 4] == pytest.approx(
        10 * 1e-4 + 1e-6 * sum((0.1 * k) ** 2 for k in range(10))
    )


def test_G3_gathered_covariance_is_that_of_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    odometry = [Odometry(stamp_ns=0, T_odom_base=SE3.identity())]
    step = SE3.exp([0.02, -0.01, 0.1, 0.3, 0.05, -0.02])
    covariance = np.diag(np.square([0.002, 0.001, 0.003, 0.01, 0.02, 0.005]))
    for i in range(1, 6):
        odometry.append(
            Odometry(stamp_ns=i, T_odom_base=odometry[-1].T_odom_base @ step, covariance=covariance)
        )
    noise = se3_exp(rng.normal(size=(20000, 5, 6)) * np.sqrt(np.diag(covariance)))
    ends = np.eye(4)
    for i in range(5):
        ends = ends @ step.matrix @ noise[:, i]
    errors = np.array(
        [SE3(e).log() for e in odometry[-1].T_odom_base.inverse().matrix @ ends[:4000]]
    )

    gathered = chosen(KeyframesConfig(distance_m=100, rotation_rad=10), odometry)[
        -1
    ].odometry.covariance

    assert gathered is not None
    np.testing.assert_allclose(gathered, np.cov(errors.T), atol=0.08 * gathered.max())


def test_a_lost_step_marks_the_keyframe_behind_it() -> None:
    odometry = straight(21)
    odometry[7] = Odometry(
        stamp_ns=odometry[7].stamp_ns, T_odom_base=odometry[7].T_odom_base, is_lost=True
    )

    frames = chosen(KeyframesConfig(), odometry)
    submaps = anyio.run(
        lambda: run_operator(SubmapBuilder(SubmapBuilderConfig()), keyframes=frames)
    )["submaps"]

    assert [f.odometry.is_lost for f in frames] == [False, True, False]
    assert [e.kind for e in submaps[0].edges] == ["motion_model", "odometry"]


def test_clouds_come_with_the_keyframes_of_their_stamps() -> None:
    odometry = straight(11)
    clouds = [
        PointCloud(stamp_ns=o.stamp_ns, points=np.full((1, 3), i)) for i, o in enumerate(odometry)
    ]

    frames = chosen(KeyframesConfig(), odometry, clouds=clouds)

    assert [int(f.cloud.points[0, 0]) for f in frames if f.cloud is not None] == [0, 10]


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.floats(0.5, 20), st.integers(2, 9))
def test_L2_submaps_join_to_the_uncut_drive(num: int, length_m: float, most: int) -> None:
    frames = chosen(KeyframesConfig(distance_m=0.1), straight(num))
    config = SubmapBuilderConfig(length_m=length_m, num_keyframes=most)

    submaps = anyio.run(lambda: run_operator(SubmapBuilder(config), keyframes=frames))["submaps"]
    map_ = Map.empty()
    for submap in submaps:
        map_ = append_submap(map_, submap)

    assert [s.index for s in submaps] == list(range(len(submaps)))
    assert all(a.keyframes[-1] is b.keyframes[0] for a, b in pairwise(submaps))
    assert map_.vertices.stamp_ns.tolist() == [f.stamp_ns for f in frames]
    assert len(map_.edges) == len(frames) - 1
    assert not check_map(map_)


def test_missions_are_named_by_what_is_in_them() -> None:
    frames = chosen(KeyframesConfig(), straight(11))

    def ids(config: SubmapBuilderConfig) -> set[str]:
        sent = anyio.run(lambda: run_operator(SubmapBuilder(config), keyframes=frames))
        return {submap.mission_id for submap in sent["submaps"]}

    assert (
        ids(SubmapBuilderConfig())
        == ids(SubmapBuilderConfig())
        != ids(SubmapBuilderConfig(mission="b"))
    )
