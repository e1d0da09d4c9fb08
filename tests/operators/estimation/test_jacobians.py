"""Every kind of edge: the Jacobians of its factors against central differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.kinds import make_factors, makers
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.states import initial_values
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import ImuSamples
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.constraints import Constraint, LandmarkRef, OuterFrame
from tests.operators.estimation.problems import (
    cov,
    disturbed,
    jacobian_error,
    wander,
    with_constraints,
    with_edge,
    with_landmark,
    with_mission,
    with_relative,
)

COVARIANCE = cov(0.02, 0.05) + 1e-5 * np.ones((6, 6))  # correlated
MOUNT = SE3.exp([0.3, -0.2, 0.5, 0.4, 0.1, -0.2])
FOUND = OuterFrame(name="room")
KNOWN = OuterFrame(name="hall", T_map_frame=SE3.exp([0.1, 0.2, 1.0, 5.0, 1.0, 2.0]))
SENSORS = {
    "tracker": {
        "T_base_sensor": [*MOUNT.t.tolist(), *MOUNT.quat_xyzw.tolist()],
        "is_extrinsics_estimated": True,
    }
}


def relative(map_: Map, truth: np.ndarray) -> Map:
    for kind in ("odometry", "wheel", "registration", "motion_model", "loop"):
        map_ = with_relative(map_, [(0, 1)], truth, COVARIANCE, kind=kind)
    return map_


def absolute(map_: Map, truth: np.ndarray) -> Map:
    made = [
        Constraint(
            stamp_ns=1,
            kind=kind,
            T_a_b=SE3(truth[0]) @ MOUNT,
            covariance=COVARIANCE,
            T_base_sensor=MOUNT if payload == b"" else SE3.identity(),
            outer=outer,
            payload=payload,
        )
        for kind in ("absolute", "position")
        for outer in (None, FOUND, KNOWN)
        for payload in (b"", b'{"sensor": "tracker"}')
    ]
    return with_constraints(map_, made)


def fixed(map_: Map, truth: np.ndarray) -> Map:
    return with_edge(map_, "fixed", vertex_a=0, T_a_b=truth[0])


def gravity(map_: Map, truth: np.ndarray) -> Map:
    payload = {"up": [0.1, 0.2, 0.9], "T_base_sensor": SENSORS["tracker"]["T_base_sensor"]}
    return with_edge(map_, "gravity", vertex_a=1, covariance=COVARIANCE, payload=payload)


def ranges(map_: Map, truth: np.ndarray) -> Map:
    map_ = with_landmark(map_, "beacon", se3_exp([0, 0, 0, 3.0, 2.0, 1.0]))
    payload = {"range_m": 3.0, "T_base_sensor": SENSORS["tracker"]["T_base_sensor"]}
    ends = {"covariance": COVARIANCE, "payload": payload}
    map_ = with_edge(map_, "range", vertex_a=0, landmark_a=0, **ends)
    return with_edge(map_, "range", vertex_a=0, vertex_b=1, **ends)


def seen(*kinds: str) -> Callable[[Map, np.ndarray], Map]:
    def build(map_: Map, truth: np.ndarray) -> Map:
        made = [
            Constraint(
                stamp_ns=1,
                kind="plane" if kind == "plane" else "landmark",
                T_a_b=SE3.exp([0.3, 0.9, 0.2, 3.0, 1.0, 0.5]),
                covariance=COVARIANCE,
                landmark=LandmarkRef(name=kind, kind=kind),
            )
            for kind in kinds
        ]
        return with_constraints(map_, made)

    return build


def wall_line(map_: Map, truth: np.ndarray) -> Map:
    """A wall that a planar laser saw: nothing is known of its rotation about x."""
    covariance = COVARIANCE.copy()
    covariance[0, :] = covariance[:, 0] = 0.0
    covariance[0, 0] = np.inf
    made = Constraint(
        stamp_ns=1,
        kind="plane",
        T_a_b=SE3.exp([0.3, 0.9, 0.2, 3.0, 1.0, 0.5]),
        covariance=covariance,
        landmark=LandmarkRef(name="wall", kind="plane"),
    )
    return with_constraints(map_, [made])


def place_of_a_pose(map_: Map, truth: np.ndarray) -> Map:
    """A sign of which only the place was seen."""
    covariance = COVARIANCE.copy()
    covariance[:3] = covariance[:, :3] = 0.0
    covariance[:3, :3] = np.diag([np.inf] * 3)
    made = Constraint(
        stamp_ns=1,
        kind="landmark",
        T_a_b=SE3.exp([0.3, 0.9, 0.2, 3.0, 1.0, 0.5]),
        covariance=covariance,
        landmark=LandmarkRef(name="sign", kind="pose"),
    )
    return with_constraints(map_, [made])


def at_the_base(map_: Map, truth: np.ndarray) -> Map:
    """A point without a bearing."""
    ref = LandmarkRef(name="p")
    made = Constraint(stamp_ns=1, kind="landmark", covariance=COVARIANCE, landmark=ref)
    return with_constraints(map_, [made])


def relations(map_: Map, truth: np.ndarray) -> Map:
    map_ = with_landmark(map_, "point", se3_exp([0, 0, 0, 1.0, 2.0, 3.0]))
    for xi in ([0.1, 0.2, 0.3, 1.0, 2.0, 2.0], [0.15, 0.2, -0.3, 1.0, -2.0, 2.0]):
        map_ = with_landmark(map_, "plane", se3_exp(xi))
    map_ = with_edge(map_, "point_on_plane", landmark_a=0, landmark_b=1, covariance=COVARIANCE)
    for kind in ("parallel", "perpendicular", "coplanar"):
        map_ = with_edge(map_, kind, landmark_a=1, landmark_b=2, covariance=COVARIANCE)
    return map_


def imu(map_: Map, truth: np.ndarray) -> Map:
    rng = np.random.default_rng(5)
    map_ = with_edge(map_, "imu", vertex_a=0, vertex_b=1)
    samples = ImuSamples(
        edge=np.zeros(60, np.int64),
        stamp_ns=np.arange(60, dtype=np.int64) * 10_000_000 - 20_000_000,
        gyro_radps=rng.normal(0, 0.3, (60, 3)),
        accel_mps2=rng.normal([0, 0, 9.81], 0.5, (60, 3)),
    )
    return replace(map_, imu=samples)


BUILDERS = {
    "relative": relative,
    "absolute": absolute,
    "fixed": fixed,
    "gravity": gravity,
    "range": ranges,
    "landmarks": seen("point", "point2d", "pose", "visual"),
    "plane": seen("plane"),
    "wall_line": wall_line,
    "place_of_a_pose": place_of_a_pose,
    "at_the_base": at_the_base,
    "relations": relations,
    "imu": imu,
}


def built(name: str) -> Map:
    rng = np.random.default_rng(11)
    truth = wander(3, rng)
    map_ = BUILDERS[name](with_mission(truth, sensors=SENSORS), truth)
    turned = disturbed(map_, rng, 0.05, 0.1)  # away from where all errors are zero
    moved = map_.landmarks.p_base + rng.normal(0, 0.1, (len(map_.landmarks), 3))
    turned = replace(turned, landmarks=replace(map_.landmarks, p_base=moved))
    if name == "fixed":
        return map_
    return replace(
        turned,
        frames=replace(map_.frames, T_map_frame=se3_exp(rng.normal(0, 0.2, (len(map_.frames), 6)))),
    )


@pytest.mark.parametrize("name", BUILDERS)
def test_E4_F8_F9_F14_jacobians_agree_with_central_differences(name: str) -> None:
    map_ = built(name)

    factors = make_factors(map_, np.arange(len(map_.edges)), NoiseModels())

    assert sorted(factors) == list(range(len(map_.edges)))
    for row, factor in factors.items():
        values = initial_values(map_, factor.keys())
        error = jacobian_error(factor, values)
        assert error < 1e-6, f"{map_.edges.kind[row]}, row {row}: {error}"


def test_E4_a_far_point_is_as_good_by_bearing_and_range() -> None:
    """gtsam's Jacobian leaves out terms in error by range, here one sigma of 0.005 m at 3 m."""
    ref = LandmarkRef(name="p")
    seen_at = SE3.exp([0.3, 0.9, 0.2, 3.0, 1.0, 0.5])
    covariance = cov(1.0, 0.005) + 5e-6 * np.ones((6, 6))
    made = Constraint(
        stamp_ns=1, kind="landmark", T_a_b=seen_at, covariance=covariance, landmark=ref
    )
    map_ = with_constraints(with_mission(wander(3, np.random.default_rng(3))), [made])
    (factor,) = make_factors(map_, np.arange(1), NoiseModels()).values()
    moved = np.array([0.002, -0.003, 0.0035])
    map_ = replace(map_, landmarks=replace(map_.landmarks, p_base=map_.landmarks.p_base + moved))
    values = initial_values(map_, factor.keys())

    assert "BearingRange" in type(factor).__name__
    assert jacobian_error(factor, values) < 1e-3
    error = seen_at.R.T @ moved
    chi2 = error @ np.linalg.inv(covariance[3:, 3:]) @ error
    assert 2 * factor.error(values) == pytest.approx(chi2, rel=0.01)


def test_E4_a_near_point_is_the_euclidean_distance() -> None:
    map_ = built("landmarks")
    factors = make_factors(map_, np.arange(1), NoiseModels())
    values = initial_values(map_, factors[0].keys())

    p_base = np.linalg.inv(map_.T_map_base(np.arange(1))[0]) @ [
        *values.atPoint3(factors[0].keys()[1]),
        1,
    ]
    measured = map_.edges.T_a_b[0]
    error = measured[:3, :3].T @ (p_base[:3] - measured[:3, 3])
    chi2 = error @ np.linalg.inv(COVARIANCE[3:, 3:]) @ error
    assert 2 * factors[0].error(values) == pytest.approx(chi2, rel=1e-12)


def test_every_kind_is_among_them() -> None:
    tested = {kind for name in BUILDERS for kind in built(name).edges.kind}

    assert set(makers()) <= tested
