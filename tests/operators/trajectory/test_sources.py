"""Sources of motion: wheels, odometry, motion models, and how they link poses."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.estimation.noise import noise_from_covariance
from mapstream.operators.trajectory.motion_models import ConstantVelocity, StandingStill
from mapstream.operators.trajectory.sources import OdometrySource, WheelSource
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.join import END
from tests.operators.trajectory.drives import (
    MS,
    WHEEL_SIGMAS,
    Robot,
    fix,
    odometry,
    pose_at,
    wheels,
)

SECOND = 1_000 * MS


def wheel_source(seconds: int = 3) -> WheelSource:
    source = WheelSource(WHEEL_SIGMAS)
    for stamp_ns in range(0, seconds * SECOND + 1, 20 * MS):
        source.add_wheels(wheels(stamp_ns))
    return source


def test_C6_wheels_answer_any_interval_and_leave_out_what_they_cannot_tell() -> None:
    source = wheel_source()
    a, b, c = 123_456_789, 987_654_321, 2_345_678_901

    first, second, whole = source.between(a, b), source.between(b, c), source.between(a, c)

    difference = (first.T_start_end @ second.T_start_end).inverse() @ whole.T_start_end
    assert np.abs(difference.log()).max() < 1e-9
    information = noise_from_covariance(whole.covariance).information()
    assert not information[[0, 1, 5]].any()  # roll, pitch, z
    assert not information[:, [0, 1, 5]].any()
    assert (np.diagonal(information)[[2, 3, 4]] > 0).all()


def test_C6_each_axis_has_a_noise_of_its_own() -> None:
    sigmas = {"roll": 0.01, "pitch": 0.02, "yaw": 0.03, "x": 0.1, "y": 0.2, "z": 0.3}
    source = WheelSource(dict(sigmas), rest_m_per_s=0.0)
    for stamp_ns in (0, SECOND):
        source.add_wheels(
            type(wheels(0))(stamp_ns=stamp_ns, T_odom_base=SE3.exp([0, 0, 0, stamp_ns / 1e9, 0, 0]))
        )

    variances = np.diagonal(source.between(0, SECOND).covariance)

    np.testing.assert_allclose(np.sqrt(variances), list(sigmas.values()), rtol=1e-9)


def test_C7_visual_odometry_at_30_hz_becomes_one_factor_for_each_pair() -> None:
    robot = Robot(window_ns=0, has_imu=False)
    stamps_ns = [round(k * SECOND / 30) for k in range(61)]
    fixes = [fix(s * MS) for s in range(10, 2000, 330)]

    map_ = robot.drive([*(odometry(s) for s in stamps_ns), *fixes])

    assert map_.edges.kind.tolist().count("odometry") == len(fixes) - 1
    edge = int(map_.edges_of("odometry")[2])
    a, b = map_.vertices.stamp_ns[[map_.edges.vertex_a[edge], map_.edges.vertex_b[edge]]].tolist()
    expected = pose_at(a).inverse() @ pose_at(b)
    np.testing.assert_allclose(map_.edges.T_a_b[edge], expected.matrix, atol=1e-9)


def test_C2_each_of_two_sources_links_each_pair_once_and_the_first_gives_the_initial_value() -> (
    None
):
    robot = Robot(window_ns=0, has_imu=False)
    both = [m for s in range(0, 2001, 100) for m in (wheels(s * MS), odometry(s * MS))]
    fixes = [fix(s * MS) for s in (50, 450, 1030, 1990)]

    map_ = robot.drive([*both, *fixes])

    pairs = list(zip(map_.edges.vertex_a, map_.edges.vertex_b, strict=True))
    for pair in ((0, 1), (1, 2), (2, 3)):
        assert pairs.count(pair) == 2
    visual = int(map_.edges_of("odometry")[0])
    T_0, T_1 = (map_.vertices.T_mission_base_of(row) for row in (0, 1))
    np.testing.assert_allclose((T_0.inverse() @ T_1).matrix, map_.edges.T_a_b[visual], atol=1e-12)


def test_C3_a_disjoint_trajectory_is_refused_with_the_pair() -> None:
    robot = Robot(window_ns=0, has_imu=False)
    stamps = [*range(0, 501, 100), *range(900, 1501, 100)]

    with pytest.raises(EstimationError, match="between the poses at 450000000 and 950000000 ns"):
        robot.drive([*(wheels(s * MS) for s in stamps), fix(450 * MS), fix(950 * MS)])


def test_C3_without_any_source_the_pair_is_named() -> None:
    robot = Robot(window_ns=0, has_imu=False)

    with pytest.raises(EstimationError, match="between the poses at 5 and 9 ns"):
        robot.drive([fix(5), fix(9)])


def test_C3_the_null_model_bridges_where_it_may() -> None:
    robot = Robot(window_ns=0, bridge=StandingStill(), has_imu=False)
    stamps = [*range(0, 501, 100), *range(900, 1501, 100)]

    map_ = robot.drive([*(wheels(s * MS) for s in stamps), *(fix(s * MS) for s in (50, 450, 950))])

    assert map_.edges.kind[map_.edges.vertex_b >= 0].tolist() == ["wheel", "motion_model"]


def test_C4_the_null_model_is_a_weak_prior_that_nothing_moved() -> None:
    motion = StandingStill().between(0, SECOND)

    np.testing.assert_array_equal(motion.T_start_end.matrix, np.eye(4))
    np.testing.assert_allclose(motion.covariance, np.eye(6) * 100.0**2)
    assert not motion.is_measured


def test_C5_the_last_velocity_goes_on_through_an_outage() -> None:
    source = OdometrySource(np.eye(6), max_gap_ns=200 * MS)
    for stamp_ns in [*range(0, 2 * SECOND, 100 * MS), 3 * SECOND]:
        source.add(odometry(stamp_ns))
    start_ns, end_ns = 19 * 100 * MS, 29 * 100 * MS

    motion = ConstantVelocity([source]).between(start_ns, end_ns)

    truth = pose_at(start_ns).inverse() @ pose_at(end_ns)
    error_m = np.linalg.norm(motion.T_start_end.t - truth.t)
    assert error_m < 0.5 * np.linalg.norm(truth.t)
    assert error_m < 1e-6  # the drive is one screw
    assert not motion.is_measured


def test_C5_where_no_velocity_is_known_nothing_moves() -> None:
    motion = ConstantVelocity([OdometrySource(np.eye(6))]).between(0, SECOND)

    np.testing.assert_array_equal(motion.T_start_end.matrix, np.eye(4))


def test_G2_there_are_as_many_poses_as_stamps_that_were_asked_for() -> None:
    robot = Robot(window_ns=0, has_imu=False)
    stamps = [50, 50, 51, 333, 333, 900]

    map_ = robot.drive(
        [*(wheels(s * MS) for s in range(0, 1001, 100)), *(fix(s * MS) for s in stamps)]
    )

    assert map_.vertices.stamp_ns.tolist() == [s * MS for s in sorted(set(stamps))]
    assert len(map_.edges_of("position")) == len(stamps)


@pytest.mark.parametrize(("window_ns", "known_ms"), [(0, 400), (1_000 * MS, 1400)])
def test_G4_a_measurement_goes_out_when_its_window_has_passed(
    window_ns: int, known_ms: int
) -> None:
    robot = Robot(window_ns=window_ns, has_imu=False)
    robot.hear(fix(400 * MS))

    for stamp_ms in range(0, 2000, 100):
        robot.hear(wheels(stamp_ms * MS))
        assert bool(robot.submaps) == (stamp_ms >= known_ms)


def test_G4_when_suppressed_all_is_held_until_the_end() -> None:
    robot = Robot(window_ns=None, has_imu=False)
    for stamp_ms in range(0, 2000, 100):
        robot.hear(wheels(stamp_ms * MS))
        robot.hear(fix(stamp_ms * MS))
        assert not robot.submaps

    robot.commit(END)

    assert len(robot.submaps[0].keyframes) == 20


def test_G5_poses_that_are_not_out_yet_are_predicted() -> None:
    robot = Robot(window_ns=10 * SECOND, has_imu=False)
    for stamp_ms in range(0, 12_001, 100):
        robot.hear(wheels(stamp_ms * MS))
        robot.hear(fix(stamp_ms * MS))

    predicted = robot.builder.predict(11_050 * MS)

    assert robot.submaps[-1].stamp_ns < 3 * SECOND
    np.testing.assert_allclose(predicted.T_odom_base.matrix, pose_at(11_050 * MS).matrix, atol=1e-9)
    with pytest.raises(EstimationError, match="no source of motion reaches"):
        robot.builder.predict(20 * SECOND)


def test_measurements_before_and_after_all_motion_are_counted() -> None:
    robot = Robot(window_ns=0, has_imu=False)
    stamps = range(1000, 2001, 100)

    map_ = robot.drive(
        [fix(5), *(wheels(s * MS) for s in stamps), *(fix(s * MS) for s in (1500, 1900, 5000))]
    )

    assert map_.vertices.stamp_ns.tolist() == [1500 * MS, 1900 * MS]
    assert sum(robot.builder.lost.values()) == 2
