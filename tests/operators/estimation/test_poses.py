"""Edges on poses alone: solved from random starts, against the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.states import initial_values
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from tests.operators.estimation.problems import (
    STEP_NS,
    Solved,
    angle_errors_deg,
    cov,
    disturbed,
    factors_of,
    position_errors_m,
    wander,
    with_constraints,
    with_edge,
    with_mission,
    with_relative,
)

OTHER = "a0" * 16
LEVER = SE3.from_rotation(np.eye(3), [0.3, 0.0, 0.4])  # 0.5 m long
COVARIANCE = cov(0.01, 0.02)


def chain(num: int) -> Iterator[tuple[int, int]]:
    return pairwise(range(num))


def measured(
    truth: FloatArray,
    rng: np.random.Generator,
    kind: str,
    *,
    mount: SE3 = LEVER,
    room: SE3 | None = None,
    sigmas: tuple[float, float] = (0.01, 0.02),
) -> list[Constraint]:
    """A measurement at each pose, in a frame of unknown place if `room` is given; [rad, m]."""
    made = []
    for at, pose in enumerate(truth):
        T = SE3.identity() if room is None else room.inverse()
        T = T @ SE3(pose) @ mount @ SE3.exp(rng.normal(size=6) * np.repeat(sigmas, 3))
        covariance = cov(*sigmas)
        if kind == "position":
            T, covariance = SE3.from_rotation(np.eye(3), T.t), cov(np.inf, sigmas[1])
        made.append(
            Constraint(
                stamp_ns=1 + at * STEP_NS,
                kind=kind,
                T_a_b=T,
                covariance=covariance,
                T_base_sensor=mount,
                outer=None if room is None else OuterFrame(name="room"),
            )
        )
    return made


def driven(num: int, seed: int) -> tuple[Map, FloatArray, np.random.Generator]:
    """Vertices without an edge, their poses, and a source of noise."""
    rng = np.random.default_rng(seed)
    truth = wander(num, rng)
    return with_mission(truth), truth, rng


def test_F4_a_wheel_knows_nothing_of_z_roll_and_pitch() -> None:
    map_, truth, _ = driven(2, 1)
    covariance = np.diag([np.inf, np.inf, 1e-4, 1e-4, 1e-4, np.inf])
    (factor,) = factors_of(with_relative(map_, [(0, 1)], truth, covariance, kind="wheel")).values()

    root = factor.noiseModel().R()

    information = root.T @ root
    assert not information[[0, 1, 5]].any()
    assert not information[:, [0, 1, 5]].any()
    np.testing.assert_allclose(information[np.ix_([2, 3, 4], [2, 3, 4])], 1e4 * np.eye(3))


@pytest.mark.parametrize("seed", range(3))
def test_F4_up_a_ramp_others_say_z_roll_and_pitch(seed: int) -> None:
    """Wheels say that the ground is flat; a height sensor and gravity say that it is not."""
    rng = np.random.default_rng(seed)
    ramp = se3_exp([0.0, -0.15, 0.0, 0.0, 0.0, 0.0])
    truth = np.array([ramp @ se3_exp([0, 0, 0.05 * k, 0.5 * k, 0, 0]) for k in range(12)])
    map_ = with_mission(truth)
    wheel = np.diag([np.inf, np.inf, 1e-7, 1e-6, 1e-6, np.inf])
    map_ = with_relative(map_, chain(12), truth, wheel, rng=rng, kind="wheel")
    height = np.diag([np.inf] * 5 + [0.002**2])
    for row, pose in enumerate(truth):
        up = pose[2, :3] + rng.normal(0, 1e-3, 3)
        map_ = with_edge(
            map_, "gravity", vertex_a=row, covariance=cov(1e-3, np.inf), payload={"up": up.tolist()}
        )
        place = np.eye(4)
        place[2, 3] = pose[2, 3] + rng.normal(0, 0.002)
        map_ = with_edge(map_, "position", vertex_a=row, covariance=height, T_a_b=place)

    solved = Solved(disturbed(map_, rng, 0.05, 0.2))

    assert position_errors_m(solved.map, truth).max() < 0.01
    assert angle_errors_deg(solved.map, truth).max() < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_F3_a_loop_between_missions_moves_both(seed: int) -> None:
    map_, truth, rng = driven(6, seed)
    other = wander(6, rng)
    apart = se3_exp([0.1, 0.2, 0.7, 3.0, -2.0, 1.0])
    map_ = with_mission(other, map_, mission=OTHER)
    both = np.concatenate([truth, apart @ other])
    covariance = cov(0.003, 0.01)
    map_ = with_relative(map_, [*chain(6)], both, covariance, rng=rng)
    map_ = with_relative(map_, [(a + 6, b + 6) for a, b in chain(6)], both, covariance, rng=rng)
    map_ = with_relative(map_, [(2, 8), (5, 11)], both, cov(1e-3, 1e-3), kind="loop")

    solved = Solved(disturbed(map_, rng, 0.05, 0.2))

    assert position_errors_m(solved.map, both).max() < 0.15
    assert not solved.map.missions.is_base_frame_known[1]
    assert np.linalg.norm(solved.map.missions.T_map_mission[1, :3, 3]) > 2  # it was thought at zero
    alone = Solved(map_.select(edges=map_.edges.kind != "loop"), hold=(0, 6))
    moved = np.abs(solved.map.vertices.T_mission_base - alone.map.vertices.T_mission_base)
    assert moved[:6].max() > 1e-3  # the loops disagree with the noise of either
    assert moved[6:].max() > 1e-3


def test_F15_a_mission_of_unknown_place_leaves_the_others_alone() -> None:
    map_, truth, rng = driven(6, 4)
    map_ = with_relative(map_, chain(6), truth, COVARIANCE, rng=rng)
    map_ = with_relative(map_, [(0, 5)], truth, COVARIANCE, rng=rng, kind="loop")
    alone = Solved(map_)
    map_ = with_mission(wander(6, rng), map_, mission=OTHER)
    both = np.concatenate([truth, map_.vertices.T_mission_base[6:]])
    beside = with_relative(map_, [(a + 6, b + 6) for a, b in chain(6)], both, COVARIANCE, rng=rng)
    beside = with_relative(beside, [(6, 11)], both, COVARIANCE, rng=rng, kind="loop")

    together = Solved(beside, hold=(0, 6))

    np.testing.assert_allclose(
        together.map.vertices.T_mission_base[:6], alone.map.vertices.T_mission_base, atol=1e-9
    )


def test_F13_measurements_of_one_pair_add_up() -> None:
    map_, truth, rng = driven(3, 5)
    once = with_relative(map_, chain(3), truth, COVARIANCE, rng=rng)
    thrice = once
    for kind in ("registration", "wheel"):
        thrice = with_relative(thrice, chain(3), truth, COVARIANCE, rng=rng, kind=kind)

    few, many = Solved(once).covariance(2), Solved(thrice).covariance(2)

    np.testing.assert_allclose(np.trace(many), np.trace(few) / 3, rtol=0.05)
    assert len(Solved(thrice).factors) == 6


@pytest.mark.parametrize("seed", range(3))
def test_F8_several_absolute_measurements_with_extrinsics_and_frame_to_find(seed: int) -> None:
    """The tracker sits elsewhere than thought, and its room lies anywhere; another one is at the base."""
    rng = np.random.default_rng(seed)
    thought, truth = SE3.exp([0.0, 0.1, 0.0, 0.1, 0.0, 0.2]), wander(20, rng)
    mount = thought @ SE3.exp([0.05, -0.03, 0.04, 0.05, 0.04, -0.03])
    room = SE3.exp([0.2, -0.1, 2.0, 4.0, 5.0, -1.0])
    place = [*thought.t.tolist(), *thought.quat_xyzw.tolist()]
    tracker = {"T_base_sensor": place, "is_extrinsics_estimated": True}
    sigmas = (0.002, 0.005)
    tracked = [
        replace(each, T_base_sensor=SE3.identity(), payload=b'{"sensor": "tracker"}')
        for each in measured(truth, rng, "absolute", mount=mount, room=room, sigmas=sigmas)
    ]
    map_ = with_mission(truth, sensors={"tracker": tracker})
    at_base = measured(truth, rng, "absolute", mount=SE3.identity(), sigmas=sigmas)
    map_ = with_constraints(map_, [*tracked, *at_base])

    solved = Solved(disturbed(map_, rng, 0.1, 0.3), hold=())

    assert len(solved.factors) == 40
    assert position_errors_m(solved.map, truth).max() < 0.02
    numbers = json.loads(solved.map.missions.sensors[0])["tracker"]["T_base_sensor"]
    found = mount.inverse() @ SE3.from_quat_xyzw(numbers[3:], numbers[:3])
    assert np.linalg.norm(found.t) < 0.01
    assert np.rad2deg(found.angle_rad) < 0.2


@pytest.mark.parametrize("kind", ["absolute", "position"])
@pytest.mark.parametrize("seed", range(3))
def test_F10_an_outer_frame_is_found_from_20_poses(kind: str, seed: int) -> None:
    """Within 1 cm where the poses are, and 0.1 degrees, though it lies 80 m away and is turned."""
    map_, truth, rng = driven(20, seed)
    map_ = with_relative(map_, chain(20), truth, cov(1e-4, 1e-4))
    room = SE3.exp([0.3, -0.2, 2.5, 40.0, -70.0, 3.0])
    made = measured(truth, rng, kind, room=room, sigmas=(0.002, 0.003))

    solved = Solved(with_constraints(map_, made))

    found = SE3(solved.map.frames.T_map_frame[0])
    error = found @ room.inverse()  # seen from the map's origin, where the poses begin
    middle = truth[:, :3, 3].mean(axis=0)
    assert np.linalg.norm(error @ middle - middle) < 0.01
    assert np.rad2deg(error.angle_rad) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_F9_positions_of_2_cm_at_half_a_metre_from_the_base(seed: int) -> None:
    map_, truth, rng = driven(30, seed)
    map_ = with_relative(map_, chain(30), truth, cov(0.002, 0.01), rng=rng)
    map_ = with_constraints(map_, measured(truth, rng, "position"))

    solved = Solved(disturbed(map_, rng, 0.1, 0.5), hold=())

    errors = position_errors_m(solved.map, truth)
    assert np.sqrt((errors**2).mean()) < 0.03
    assert angle_errors_deg(solved.map, truth).max() < 1.5


def test_F9_a_position_alone_says_nothing_of_the_rotation_about_its_arm() -> None:
    map_, truth, rng = driven(2, 6)
    one = with_constraints(map_, measured(truth, rng, "position")[:1])
    (factor,) = factors_of(one).values()

    J, _ = factor.linearize(initial_values(map_, [0])).jacobian()

    values = np.linalg.svd(J, compute_uv=False)
    assert J.shape == (3, 6)
    assert np.linalg.matrix_rank(J.T @ J) == 3  # of six directions
    assert values.min() > 0


@pytest.mark.parametrize("seed", range(3))
def test_F16_gravity_levels_a_robot(seed: int) -> None:
    """A standing robot tilted by up to 20 degrees; the accelerometer's mean has 2 mrad of noise."""
    map_, truth, rng = driven(3, seed)
    map_ = with_relative(map_, chain(3), truth, cov(0.001, 0.01))
    mount = SE3.exp([0.2, 0.5, -0.4, 0.1, 0.2, 0.3])
    for row, pose in enumerate(truth):
        up = mount.R.T @ pose[2, :3] + rng.normal(0, 0.002, 3)
        payload = {
            "up": (9.81 * up).tolist(),
            "T_base_sensor": [*mount.t.tolist(), *mount.quat_xyzw.tolist()],
        }
        map_ = with_edge(
            map_, "gravity", vertex_a=row, covariance=cov(0.002, np.inf), payload=payload
        )
    place = with_edge(map_, "position", vertex_a=0, covariance=cov(np.inf, 0.01))
    yaw = np.diag([np.inf, np.inf, 1e-4, np.inf, np.inf, np.inf])
    place = with_edge(place, "absolute", vertex_a=0, covariance=yaw)
    tilted = place.vertices.T_mission_base @ se3_exp([*rng.uniform(-0.35, 0.35, 2), 0, 0, 0, 0])

    solved = Solved(
        replace(place, vertices=replace(place.vertices, T_mission_base=tilted)), hold=()
    )

    up_error = np.arccos(solved.map.vertices.T_mission_base[:, 2, :3] @ truth[:, 2, :3].T)
    assert np.rad2deg(np.diagonal(up_error)).max() < 0.3


def test_fixed_edges_hold_where_they_say() -> None:
    map_, truth, rng = driven(3, 7)
    map_ = with_relative(map_, chain(3), truth, COVARIANCE, rng=rng)
    elsewhere = se3_exp([0, 0, 1.0, 5.0, 0, 0])
    map_ = with_edge(map_, "fixed", vertex_a=0, T_a_b=elsewhere)

    solved = Solved(map_, hold=())

    np.testing.assert_allclose(solved.map.vertices.T_mission_base[0], elsewhere, atol=1e-9)


def test_a_switched_measurement_in_an_unknown_frame_gets_another_noise() -> None:
    """Robust losses work on factors that gtsam does not have, too."""
    map_, truth, rng = driven(3, 8)
    room = SE3.exp([0, 0, 1.0, 2.0, 3.0, 4.0])
    map_ = with_constraints(map_, measured(truth, rng, "position", room=room)[:1])
    (factor,) = factors_of(map_).values()
    values = initial_values(map_, factor.keys())
    values.update(key_of("frame", 0), gtsam.Pose3())

    half = factor.cloneWithNewNoiseModel(gtsam.noiseModel.Isotropic.Sigma(3, 0.04))

    assert factor.keys() == [0, key_of("frame", 0)]
    assert half.error(values) == pytest.approx(factor.error(values) / 4)
