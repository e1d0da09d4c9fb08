"""What poses in a map are worth."""

import numpy as np
import pytest

from mapstream.recordings.localization import score_poses
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose
from mapstream.streams.trajectory import Trajectory


def _pose(stamp_ns: int, x_m: float | None) -> MapPose:
    if x_m is None:
        return MapPose(stamp_ns=stamp_ns, state="lost")
    T = SE3.from_rotation(np.eye(3), [x_m, 0, 0])
    return MapPose(stamp_ns=stamp_ns, state="tracking", T_map_base=T)


_TRUTH = Trajectory(stamps_ns=np.arange(5), poses=np.tile(np.eye(4), (5, 1, 1)))


def test_R5_recall_is_of_all_poses_and_precision_of_those_found() -> None:
    poses = [_pose(0, 0.0), _pose(1, None), _pose(2, 0.1), _pose(3, 4.0), _pose(9, 0.0)]

    score = score_poses(poses, _TRUTH)

    assert (score.num_poses, score.num_found, score.num_right) == (4, 3, 2)  # 9 ns has no truth
    assert score.recall == pytest.approx(2 / 4)
    assert score.precision == pytest.approx(2 / 3)
    assert score.states == {"lost": 1, "tracking": 3}
    assert score.distance_m is not None
    assert score.distance_m.median == pytest.approx(0.1)


def test_R5_without_truth_what_was_found_is_counted() -> None:
    score = score_poses([_pose(0, 0.0), _pose(1, None)])

    assert (score.num_poses, score.num_found) == (2, 1)
    assert np.isnan(score.recall)
    assert score.distance_m is None


def test_R5_a_robot_that_was_never_found_has_no_errors() -> None:
    score = score_poses([_pose(0, None)], _TRUTH)

    assert score.num_found == 0
    assert score.recall == 0
    assert score.distance_m is None
