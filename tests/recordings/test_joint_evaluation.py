"""Several robots are judged together: what one alignment for each hides, one for all shows."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.recordings.joint_evaluation import joint_ape
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp

FRAME = SE3.exp([0.1, 0.2, 0.3, 10.0, 20.0, 30.0])


def robot(seed: int, T_wrong: SE3 | None = None, num: int = 40) -> PosePairs:
    """A robot on a way of its own; the map has it in another frame, and moved by an error."""
    steps = np.random.default_rng(seed).normal(size=(num, 6)) * [0.1, 0.1, 0.1, 1, 1, 1]
    reference = np.array([SE3.identity().matrix] * num)
    for i, step in enumerate(se3_exp(steps)[1:], start=1):
        reference[i] = reference[i - 1] @ step
    estimate = ((T_wrong or SE3.identity()).inverse() @ FRAME).matrix @ reference
    return PosePairs(stamps_ns=np.arange(num), estimate=estimate, reference=reference)


def test_R3_a_frame_that_all_share_is_no_error() -> None:
    found = joint_ape({"a": robot(0), "b": robot(1)})

    assert found.translation.rmse < 1e-9
    assert found.rotation_deg.max < 1e-5
    assert found.translation.count == 80


def test_R3_a_robot_in_the_wrong_place_shows_in_the_joint_score_alone() -> None:
    shifted = SE3.from_rotation(np.eye(3), [3.0, 0, 0])

    found = joint_ape({"a": robot(0), "b": robot(1, shifted)})

    assert found.translation.rmse > 0.5  # half of 3 m at most, less what a rotation takes up
    for errors in found.robots.values():
        assert errors.own is not None
        assert errors.own.translation.rmse < 1e-9
        assert errors.joint.translation.rmse > 0.5


def test_R3_the_joint_score_is_that_of_one_trajectory_of_all_poses() -> None:
    a, b = robot(0), robot(1, SE3.exp([0, 0, 0.1, 1.0, 0, 0]))
    together = PosePairs(
        stamps_ns=np.arange(80),
        estimate=np.concatenate([a.estimate, b.estimate]),
        reference=np.concatenate([a.reference, b.reference]),
    )

    joint = joint_ape({"a": a, "b": b}).translation
    one = joint_ape({"all": together}).robots["all"].own

    assert one is not None
    assert joint == one.translation


def test_a_robot_that_stands_has_no_alignment_of_its_own() -> None:
    still = robot(0, num=1)

    found = joint_ape({"a": robot(1), "still": still})

    assert found.robots["still"].own is None
    with pytest.raises(EstimationError, match="there is no robot"):
        joint_ape({})
