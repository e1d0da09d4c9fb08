from __future__ import annotations

import numpy as np
import pytest

from mapstream.streams.geometry import se3_exp
from mapstream.streams.shaped_trajectory import ShapedTrajectory
from mapstream.streams.trajectory import Trajectory

RATE_HZ = 100


def truth(seconds: float = 20.0) -> Trajectory:
    """A winding walk at 1.5 m/s that also climbs and rolls."""
    t = np.arange(int(seconds * RATE_HZ) + 1) / RATE_HZ
    turns = np.stack([0.1 * np.sin(t), 0.05 * np.cos(2 * t), 0.8 * np.sin(0.7 * t)], axis=1)
    steps = np.concatenate([turns, np.tile([1.5, 0, 0.1], (len(t), 1))], axis=1) / RATE_HZ
    poses = [np.eye(4)]
    for step in se3_exp(steps[1:]):
        poses.append(poses[-1] @ step)
    return Trajectory(stamps_ns=(t * 1e9).round().astype(np.int64), poses=np.array(poses))


def drifting(trajectory: Trajectory, seed: int) -> Trajectory:
    """Odometry with a scale error of 1 %, a turn of 0.5 deg per 10 m, and noise."""
    rng = np.random.default_rng(seed)
    steps = np.linalg.inv(trajectory.poses[:-1]) @ trajectory.poses[1:]
    bias = np.array([0, 0, np.radians(0.5) / 10 * 0.015, 0, 0, 0])
    noise = se3_exp(bias + rng.normal(size=(len(steps), 6)) * [1e-5] * 6)
    steps[:, :3, 3] *= 1.01
    poses = [trajectory.poses[0]]
    for step, error in zip(steps, noise, strict=True):
        poses.append(poses[-1] @ step @ error)
    return Trajectory(stamps_ns=trajectory.stamps_ns, poses=np.array(poses))


@pytest.mark.parametrize("seed", range(20))
def test_G10_between_vertices_the_pose_is_right_to_two_millimetres(seed: int) -> None:
    """A vertex each half second; asked at 100 Hz."""
    true = truth()
    anchors = Trajectory(stamps_ns=true.stamps_ns[::50], poses=true.poses[::50])

    asked = ShapedTrajectory(anchors=anchors, shape=drifting(true, seed)).at(true.stamps_ns)

    error_m = np.linalg.norm(asked[:, :3, 3] - true.poses[:, :3, 3], axis=1)
    assert error_m.max() < 0.002


def test_G10_it_goes_through_every_vertex() -> None:
    true = truth(5.0)
    anchors = Trajectory(stamps_ns=true.stamps_ns[::77], poses=true.poses[::77])

    asked = ShapedTrajectory(anchors=anchors, shape=drifting(true, 1)).at(anchors.stamps_ns)

    np.testing.assert_allclose(asked, anchors.poses, atol=1e-12)


def test_G10_nothing_is_extrapolated() -> None:
    true = truth(1.0)
    anchors = Trajectory(stamps_ns=true.stamps_ns[10:50:10], poses=true.poses[10:50:10])

    with pytest.raises(ValueError, match="outside the anchors"):
        ShapedTrajectory(anchors=anchors, shape=true).at([0])
