"""Poses over time: interpolation, order, refusals; and the triggers that live on them."""

from bisect import bisect_left, bisect_right

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.trajectory import Trajectory
from mapstream.streams.triggers import Always, AnyOf, OnMotion, Periodic

SECOND = 1_000_000_000
TWIST = np.array([0.1, -0.2, 0.3, 1.0, 0.5, -0.2])  # per second


def _trajectory(*stamps_ns: int) -> Trajectory:
    stamps = np.array(stamps_ns, np.int64)
    return Trajectory(stamps_ns=stamps, poses=se3_exp(stamps[:, None] / SECOND * TWIST))


@given(st.lists(st.integers(0, 99), min_size=1, unique=True), st.integers(-1, 100))
def test_B7_order_queries_find_the_neighbours(stamps_ns: list[int], stamp_ns: int) -> None:
    stamps_ns.sort()
    trajectory = _trajectory(*stamps_ns)

    left, right = bisect_left(stamps_ns, stamp_ns), bisect_right(stamps_ns, stamp_ns)
    assert trajectory.stamp_before(stamp_ns) == (stamps_ns[left - 1] if left else None)
    assert trajectory.stamp_after(stamp_ns) == (
        stamps_ns[right] if right < len(stamps_ns) else None
    )


def test_poses_are_exact_at_their_stamps_and_interpolated_between() -> None:
    trajectory = _trajectory(0, SECOND, 3 * SECOND)

    found = trajectory.at([0, 2 * SECOND, SECOND, 3 * SECOND])

    np.testing.assert_allclose(found[[0, 2, 3]], trajectory.poses, atol=1e-12)
    expected = SE3(trajectory.poses[1]).interpolate(SE3(trajectory.poses[2]), 0.5)
    np.testing.assert_allclose(found[1], expected.matrix, atol=1e-12)
    np.testing.assert_allclose(trajectory.pose_at(2 * SECOND).matrix, found[1])


def test_motion_between_two_times_composes() -> None:
    trajectory = _trajectory(0, SECOND, 3 * SECOND)

    whole = trajectory.between(SECOND // 3, 2 * SECOND)
    parts = trajectory.between(SECOND // 3, SECOND) @ trajectory.between(SECOND, 2 * SECOND)

    np.testing.assert_allclose(whole.matrix, parts.matrix, atol=1e-12)


def test_nothing_is_extrapolated() -> None:
    trajectory = _trajectory(5, 9)

    assert (trajectory.covers(4), trajectory.covers(5), trajectory.covers(10)) == (
        False,
        True,
        False,
    )
    with pytest.raises(ValueError, match="stamp 10 lies outside the trajectory, 5 to 9"):
        trajectory.at([6, 10])
    with pytest.raises(ValueError, match="empty trajectory answers no stamp"):
        _trajectory().pose_at(0)


def test_one_pose_answers_its_own_stamp() -> None:
    np.testing.assert_allclose(_trajectory(5).pose_at(5).matrix, _trajectory(5).poses[0])


@pytest.mark.parametrize("stamps_ns", [(1, 1), (2, 1)])
def test_stamps_must_increase(stamps_ns: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="stamps must increase"):
        _trajectory(*stamps_ns)


def test_stamps_near_today_keep_their_nanoseconds() -> None:
    start_ns = 1_800_000_000 * SECOND + 1
    trajectory = Trajectory(
        stamps_ns=np.array([start_ns, start_ns + 10]), poses=se3_exp(np.outer([0, 10], TWIST))
    )

    np.testing.assert_allclose(trajectory.pose_at(start_ns + 3).t, 0.3 * trajectory.poses[1, :3, 3])


def test_B16_a_1_hz_trigger_fires_at_most_once_per_second() -> None:
    trigger = Periodic(SECOND)
    stamps_ns = range(0, 10 * SECOND, 70_000_000)

    fired = [t for t in stamps_ns if trigger.fires(t, SE3.identity())]

    assert fired[0] == 0
    assert len(fired) == 10
    assert np.diff(fired).min() >= SECOND


def test_B9_an_output_of_20_hz_is_limited_to_10() -> None:
    limit = Periodic(SECOND // 10)

    fired = [t for t in range(0, SECOND, SECOND // 20) if limit.fires(t, SE3.identity())]

    assert fired == list(range(0, SECOND, SECOND // 10))


def test_B16_on_motion_fires_by_distance_or_by_angle() -> None:
    trigger = OnMotion(distance_m=1.0, angle_rad=0.5)
    path = [(0.0, 0.0), (0.9, 0.0), (1.0, 0.0), (1.0, 0.4), (1.0, 0.5), (1.9, 0.8), (2.0, 0.9)]

    fired = [
        trigger.fires(i, SE3.from_rotation(SE3.exp([0, 0, yaw, 0, 0, 0]).R, [x, 0, 0]))
        for i, (x, yaw) in enumerate(path)
    ]

    assert fired == [True, False, True, False, True, False, True]


def test_B16_any_of_several_restarts_all() -> None:
    """A metre after 3 s also begins the period of 5 s anew: the next is due at 8 s, not at 5 s."""
    trigger = AnyOf([OnMotion(1.0, 0.5), Periodic(5 * SECOND)])

    fired = [
        t
        for t in range(10)
        if trigger.fires(t * SECOND, SE3.exp([0, 0, 0, 1.0 if t >= 3 else 0.0, 0, 0]))
    ]

    assert fired == [0, 3, 8]


def test_B16_always_fires_always() -> None:
    assert all(Always().fires(i, SE3.identity()) for i in range(3))


def test_B16_triggers_refuse_what_would_never_end() -> None:
    with pytest.raises(ValueError, match="a period is positive, not 0 ns"):
        Periodic(0)
    with pytest.raises(ValueError, match="motion is positive, not 0 m and 1 rad"):
        OnMotion(0, 1)
