"""Trajectory errors, against evo's numbers, the KITTI formula by hand, and known transforms."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.evaluation import (
    PosePairs,
    align,
    ape,
    associate,
    kitti_drift,
    rpe,
)
from mapstream.recordings.trajectory_files import read_tum
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import se3_exp, so3_exp
from mapstream.streams.trajectory import Trajectory

GOLDEN = Path(__file__).parent / "golden"

EVO: dict[str, Any] = json.loads((GOLDEN / "evo.json").read_text())  # says how it was made


def golden_pairs() -> PosePairs:
    return associate(read_tum(GOLDEN / "estimate.tum"), read_tum(GOLDEN / "reference.tum"))


def path_of(steps: FloatArray) -> Trajectory:
    """Chain motions (N, 6), 0.1 s apart."""
    poses = [np.eye(4)]
    for step in se3_exp(steps):
        poses.append(poses[-1] @ step)
    return Trajectory(stamps_ns=np.arange(len(poses)) * 100_000_000, poses=np.array(poses))


@pytest.mark.parametrize("golden", EVO["ape"], ids=lambda golden: golden["options"])
def test_R1_ape_equals_evo(golden: dict[str, Any]) -> None:
    """All statistics agree with evo's to 1e-6."""
    found = asdict(getattr(ape(golden_pairs(), golden["mode"]), golden["kind"]))

    assert found.pop("count") == 60
    assert found == pytest.approx(golden["statistics"], abs=1e-6, rel=0)


@pytest.mark.parametrize("golden", EVO["rpe"], ids=lambda golden: golden["options"])
def test_R2_rpe_equals_evo(golden: dict[str, Any]) -> None:
    """All statistics agree with evo's to 1e-6."""
    found = asdict(getattr(rpe(golden_pairs(), **golden["arguments"]), golden["kind"]))

    found.pop("count")
    assert found == pytest.approx(golden["statistics"], abs=1e-6, rel=0)


def test_R2_kitti_drift_by_hand() -> None:
    """251 frames of 1 m along x, estimated 1 % too long and turning 1 mrad a frame.

    The devkit starts a segment at every tenth frame and ends it at the first frame *beyond* the length,
    so those of 100 m span 101 frames and those of 200 m span 201; frames 0, 10 ... 140 start one of
    100 m and frames 0 ... 40 one of 200 m. The estimate of n frames is a polygon with sides of 1.01 m.
    """
    reference = path_of(np.tile([0, 0, 0, 1.0, 0, 0], (250, 1)))
    estimate = np.tile(np.eye(4), (251, 1, 1))
    turn = np.arange(251) * 1e-3
    estimate[:, :3, :3] = so3_exp(np.stack([turn * 0, turn * 0, turn], axis=1))
    estimate[1:, 0, 3] = np.cumsum(1.01 * np.cos(turn[:-1]))
    estimate[1:, 1, 3] = np.cumsum(1.01 * np.sin(turn[:-1]))
    expected_t, expected_r = [], []
    for frames, length, count in ((101, 100, 15), (201, 200, 5)):
        angles = np.arange(frames) * 1e-3
        end = 1.01 * np.array([np.cos(angles).sum(), np.sin(angles).sum()])
        # error = inverse(estimated motion) * true motion; its translation has the length of the miss
        miss = np.linalg.norm(end - [frames, 0]) / length
        expected_t += [miss] * count
        expected_r += [frames * 1e-3 / length] * count

    drift = kitti_drift(
        associate(Trajectory(stamps_ns=reference.stamps_ns, poses=estimate), reference)
    )

    assert sorted(drift.lengths_m.tolist()) == [100.0] * 15 + [200.0] * 5
    assert drift.translation_percent == pytest.approx(100 * np.mean(expected_t), abs=1e-6)
    assert drift.rotation_degpm == pytest.approx(np.rad2deg(np.mean(expected_r)), abs=1e-6)


@given(
    seed=st.integers(0, 1000),
    xi=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    scale=st.floats(0.1, 10),
)
def test_R1_sim3_alignment_undoes_a_similarity(seed: int, xi: list[float], scale: float) -> None:
    """A trajectory that was scaled, turned and moved is brought back."""
    reference = path_of(np.random.default_rng(seed).uniform(-1, 1, (12, 6)))
    moved = se3_exp(xi) @ reference.poses
    moved[:, :3, 3] *= scale
    estimate = Trajectory(stamps_ns=reference.stamps_ns, poses=moved)

    alignment = align(associate(estimate, reference), "sim3")

    assert alignment.scale == pytest.approx(1 / scale)
    np.testing.assert_allclose(alignment.apply(moved), reference.poses, atol=1e-6)


@given(seed=st.integers(0, 1000), yaw=st.floats(-3, 3))
def test_R1_yaw_alignment_turns_about_z_alone(seed: int, yaw: float) -> None:
    """It undoes a turn about z, keeps z, and no other turn about z fits better."""
    rng = np.random.default_rng(seed)
    reference = path_of(rng.uniform(-1, 1, (12, 6)))
    poses = se3_exp([0, 0, yaw, 1, 2, 3]) @ reference.poses
    poses[:, :3, 3] += rng.normal(0, 0.1, (13, 3))
    pairs = associate(Trajectory(stamps_ns=reference.stamps_ns, poses=poses), reference)

    best = align(pairs, "yaw")

    np.testing.assert_allclose(best.R[:, 2], [0, 0, 1], atol=1e-12)
    x = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    y = reference.poses[:, :3, 3] - reference.poses[:, :3, 3].mean(axis=0)
    costs = [
        np.sum((x @ (so3_exp([0, 0, d]) @ best.R).T - y) ** 2) for d in (0.0, 0.01, -0.01, 3.0)
    ]
    assert costs[0] == min(costs)


def test_a_straight_line_has_no_se3_alignment_but_a_yaw() -> None:
    """The message says why, and what to do."""
    line = path_of(np.tile([0, 0, 0, 1.0, 0, 0], (5, 1)))

    with pytest.raises(EstimationError, match=r"lie on one line.*align yaw only"):
        ape(associate(line, line), "se3")

    assert ape(associate(line, line), "yaw").translation.max < 1e-12


def test_association_by_interpolation() -> None:
    """Between its poses the reference is asked for its motion; outside, nothing is invented."""
    reference = path_of(np.tile([0, 0, 0, 1.0, 0, 0], (2, 1)))
    estimate = Trajectory(
        stamps_ns=np.array([-1, 50_000_000, 10**9]), poses=np.tile(np.eye(4), (3, 1, 1))
    )

    pairs = associate(estimate, reference, interpolate=True)

    assert pairs.stamps_ns.tolist() == [50_000_000]
    np.testing.assert_allclose(pairs.reference[0, :3, 3], [0.5, 0, 0])


@pytest.mark.parametrize("interpolate", [False, True])
def test_stamps_that_never_match_are_an_error(*, interpolate: bool) -> None:
    """Both spans are in the message."""
    one = Trajectory(stamps_ns=np.array([5]), poses=np.eye(4)[None])
    other = Trajectory(stamps_ns=np.array([10**10]), poses=np.eye(4)[None])

    with pytest.raises(EstimationError, match="span 5 to 5 ns and 10000000000 to 10000000000 ns"):
        associate(one, other, interpolate=interpolate)


def test_too_short_for_the_metric() -> None:
    """RPE and KITTI name what is missing."""
    pairs = associate(*[path_of(np.tile([0, 0, 0, 1.0, 0, 0], (5, 1)))] * 2)

    with pytest.raises(EstimationError, match="too short for motions over 10 frames"):
        rpe(pairs, delta=10)
    with pytest.raises(EstimationError, match=r"over 0\.5 frames: give metres, or whole frames"):
        rpe(pairs, delta=0.5)
    with pytest.raises(EstimationError, match=r"segments of 100 m; the reference is 5\.0 m long"):
        kitti_drift(pairs)
