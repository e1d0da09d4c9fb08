"""The laws of a continuous pose source."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.odometry.continuous import ContinuousSource
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry

PERIOD_NS = 5_000_000  # 200 Hz
STEP_COVARIANCE = np.diag([1e-8] * 3 + [1e-6] * 3)


def source(seconds: float = 2.0, seed: int = 0) -> ContinuousSource:
    """Return a source of 200 Hz that wanders."""
    rng = np.random.default_rng(seed)
    made = ContinuousSource(np.eye(6))
    T = SE3.identity()
    for k in range(int(seconds * 1e9 / PERIOD_NS) + 1):
        made.add(Odometry(stamp_ns=k * PERIOD_NS, T_odom_base=T, covariance=STEP_COVARIANCE))
        T = T @ SE3.exp(rng.normal([0, 0, 0.005, 0.01, 0, 0], 0.002))
    return made


WANDER = source()
STAMPS = st.lists(st.integers(0, 2_000_000_000), min_size=3, max_size=3).map(sorted)


@settings(max_examples=50, deadline=None)
@given(STAMPS)
def test_C1_motions_over_adjoining_intervals_compose_exactly(stamps_ns: list[int]) -> None:
    a, b, c = stamps_ns

    first, second, whole = (WANDER.between(*p) for p in ((a, b), (b, c), (a, c)))

    difference = (first.T_start_end @ second.T_start_end).inverse() @ whole.T_start_end
    assert np.abs(difference.log()).max() < 1e-9


def test_G3_two_hundred_messages_a_second_become_five_factors() -> None:
    motions = WANDER.links(range(0, 2_000_000_001, 200_000_000))

    assert len(motions) == 10
    assert all(motion.is_measured for motion in motions)


@settings(max_examples=30, deadline=None)
@given(STAMPS)
def test_G3_the_covariance_grows_with_the_interval(stamps_ns: list[int]) -> None:
    a, b, c = stamps_ns

    short, long = WANDER.between(a, b), WANDER.between(a, c)

    rotation_short, rotation_long = (np.trace(m.covariance[:3, :3]) for m in (short, long))
    assert rotation_long >= rotation_short
    np.testing.assert_allclose(
        rotation_long, (c - a) / PERIOD_NS * np.trace(STEP_COVARIANCE[:3, :3]), rtol=1e-6
    )


def test_a_share_of_a_step_has_a_share_of_its_covariance() -> None:
    motion = WANDER.between(PERIOD_NS // 4, PERIOD_NS // 2)

    np.testing.assert_allclose(motion.covariance, STEP_COVARIANCE / 4, rtol=1e-6)


def test_just_past_the_newest_message_it_predicts_and_says_so() -> None:
    made = ContinuousSource(np.eye(6))
    for k in range(3):
        made.add(Odometry(stamp_ns=k * 10**8, T_odom_base=SE3.exp([0, 0, 0, 0.1 * k, 0, 0])))

    motion = made.between(2 * 10**8, 7 * 10**8)

    np.testing.assert_allclose(motion.T_start_end.t, [0.5, 0, 0], atol=1e-12)
    assert not motion.is_measured
    assert motion.covariance[5, 5] > 1.0


@pytest.mark.parametrize(("start_ns", "end_ns"), [(-1, 10), (0, 2_500_000_001), (10, 5)])
def test_C1_outside_it_is_unavailable_and_says_what_there_is(start_ns: int, end_ns: int) -> None:
    with pytest.raises(EstimationError, match="unavailable; there is 0 to 2000000000 ns"):
        WANDER.between(start_ns, end_ns)


def test_a_single_message_answers_nothing() -> None:
    made = ContinuousSource(np.eye(6))
    made.add(Odometry(stamp_ns=5, T_odom_base=SE3.identity()))

    with pytest.raises(EstimationError, match="no two messages yet"):
        made.between(5, 5)


def test_messages_that_run_backwards_are_refused() -> None:
    made = ContinuousSource(np.eye(6))
    made.add(Odometry(stamp_ns=5, T_odom_base=SE3.identity()))

    with pytest.raises(EstimationError, match="not newer"):
        made.add(Odometry(stamp_ns=5, T_odom_base=SE3.identity()))


def test_an_unmeasured_step_is_not_called_measured() -> None:
    made = ContinuousSource(np.eye(6))
    for k in range(4):
        made.add(Odometry(stamp_ns=k * 10**8, T_odom_base=SE3.identity(), is_lost=k == 2))

    assert made.between(0, 10**8).is_measured
    assert not made.between(0, 2 * 10**8).is_measured
    assert made.between(2 * 10**8, 3 * 10**8).is_measured


SECOND = 1_000_000_000
TWIST = np.array([0.1, -0.2, 0.3, 1.0, 0.5, -0.2])  # per second


def _buffer(seconds: int, rate_hz: int = 10) -> ContinuousSource:
    buffer = ContinuousSource(np.eye(6))
    for i in range(seconds * rate_hz + 1):
        T_odom_base = SE3.exp(TWIST * i / rate_hz)
        buffer.add(Odometry(stamp_ns=i * SECOND // rate_hz, T_odom_base=T_odom_base))
    return buffer


def test_B10_the_buffer_keeps_30_s() -> None:
    buffer = _buffer(40)

    assert len(buffer) == 301
    buffer.pose_at(10 * SECOND)
    with pytest.raises(EstimationError, match="there is 10000000000 to 40000000000 ns"):
        buffer.pose_at(10 * SECOND - 1)


def test_B10_up_to_500_ms_beyond_the_newest_are_predicted() -> None:
    buffer = _buffer(5)

    for ahead_ns in (1, SECOND // 4, SECOND // 2):
        pose = buffer.pose_at(5 * SECOND + ahead_ns)
        assert not buffer.between(5 * SECOND, 5 * SECOND + ahead_ns).is_measured
        truth = SE3.exp(TWIST * (5 + ahead_ns / SECOND))
        np.testing.assert_allclose(pose.matrix, truth.matrix, atol=1e-9)


def test_B10_later_is_refused() -> None:
    with pytest.raises(EstimationError, match="500 ms beyond"):
        _buffer(5).pose_at(5 * SECOND + SECOND // 2 + 1_000_000)
    with pytest.raises(EstimationError, match="no two messages yet"):
        _buffer(0).pose_at(1)


def test_B10_between_measurements_the_buffer_interpolates() -> None:
    pose = _buffer(5).pose_at(SECOND + SECOND // 20)

    np.testing.assert_allclose(pose.matrix, SE3.exp(TWIST * 1.05).matrix, atol=1e-12)


def test_B10_time_that_runs_backwards_is_refused_until_cleared() -> None:
    buffer = _buffer(1)
    again = Odometry(stamp_ns=0, T_odom_base=SE3.identity())
    with pytest.raises(EstimationError, match="odometry at 0 ns is not newer than at 1000000000"):
        buffer.add(again)

    buffer.clear()
    buffer.add(again)

    assert len(buffer) == 1


def test_a_gap_is_not_interpolated() -> None:
    made = ContinuousSource(np.eye(6), max_gap_ns=10**8)
    for stamp_ns in (0, 10**8, 3 * 10**8, 4 * 10**8):
        made.add(Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity()))

    assert made.measures(0, 10**8)
    assert made.measures(3 * 10**8, 4 * 10**8)
    assert not made.measures(0, 2 * 10**8)
    with pytest.raises(EstimationError, match="less gaps over 100 ms"):
        made.between(5 * 10**7, 35 * 10**7)


def test_A10_the_state_at_a_stamp_has_velocity_and_biases_of_the_nearest_message() -> None:
    made = ContinuousSource(np.eye(6))
    for k in range(3):
        made.add(
            Odometry(
                stamp_ns=k * 10**8,
                T_odom_base=SE3.exp([0, 0, 0, 0.1 * k, 0, 0]),
                velocity_mps=np.array([1.0, 0, 0]),
                gyro_bias_radps=np.full(3, 0.01 * k),
            )
        )

    state = made.state_at(16 * 10**7)

    np.testing.assert_allclose(state.T_odom_base.t, [0.16, 0, 0])
    assert state.gyro_bias_radps is not None
    np.testing.assert_allclose(state.gyro_bias_radps, 0.02)
