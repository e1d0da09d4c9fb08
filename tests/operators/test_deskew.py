"""Motion compensation against points whose places are known."""

import numpy as np
import pytest

from mapstream.operators.lidar.deskew import deskew_along, deskew_by_velocity, gyro_trajectory
from mapstream.streams.geometry import SE3, invert, se3_exp
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.trajectory import Trajectory
from tests.data import shared

SWEEP_NS = 100_000_000


def _sweep(twist: np.ndarray, n: int = 3000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points as seen along a steady motion [per sweep], their times, and their places at its end."""
    rng = np.random.default_rng(0)
    offsets_ns = np.sort(rng.integers(0, SWEEP_NS, n))
    offsets_ns[[0, -1]] = 0, SWEEP_NS
    at_end = rng.uniform(-50, 50, (n, 3))
    T_end_point = se3_exp((offsets_ns / SWEEP_NS - 1)[:, None] * twist)
    seen = np.einsum("nij,nj->ni", invert(T_end_point)[:, :3, :3], at_end)
    seen += invert(T_end_point)[:, :3, 3]
    return seen, offsets_ns, at_end


@pytest.mark.parametrize(
    "twist", [[0, 0, np.pi / 20, 0.3, 0, 0], [0.05, -0.1, 0.1, 2.0, 0.5, -0.1], [0] * 6]
)
def test_I17_a_steady_motion_is_undone(twist: list[float]) -> None:
    """At 90 deg/s and more, and 70 m out, to a tenth of a millimetre."""
    seen, offsets_ns, at_end = _sweep(np.array(twist, dtype=float))

    found = deskew_by_velocity(seen, offsets_ns, SE3.exp(twist), SWEEP_NS)

    np.testing.assert_allclose(found, at_end, atol=2e-3)


def test_I17_the_step_may_be_longer_than_the_sweep() -> None:
    """A scan every half second, of which the sweep takes a tenth."""
    twist = np.array([0, 0, 0.05, 0.1, 0, 0])
    seen, offsets_ns, at_end = _sweep(twist)

    found = deskew_by_velocity(seen, offsets_ns, SE3.exp(5 * twist), 5 * SWEEP_NS)

    np.testing.assert_allclose(found, at_end, atol=2e-3)


def test_a_known_trajectory_undoes_any_motion() -> None:
    twist = np.array([0.02, 0, 0.2, 0.3, 0, 0])
    seen, offsets_ns, at_end = _sweep(twist)
    start_ns = 1_700_000_000 * 10**9
    stamps_ns = start_ns + np.linspace(0, SWEEP_NS, 201).astype(np.int64)
    poses = se3_exp(((stamps_ns - start_ns) / SWEEP_NS)[:, None] * twist)

    found = deskew_along(seen, start_ns + offsets_ns, Trajectory(stamps_ns=stamps_ns, poses=poses))

    np.testing.assert_allclose(found, at_end, atol=2e-3)


@pytest.mark.parametrize("duration_ns", [99_444_444, 99_444_445, 99_999_999])
def test_a_trajectory_that_ends_with_the_sweep_covers_it(duration_ns: int) -> None:
    stamps_ns = 1_700_000_000 * 10**9 + np.array([0, duration_ns])
    standing = Trajectory(stamps_ns=stamps_ns, poses=np.repeat(np.eye(4)[None], 2, axis=0))
    seen = np.ones((2, 3))

    np.testing.assert_array_equal(deskew_along(seen, stamps_ns, standing), seen)


def test_a_sweep_outside_the_trajectory_is_refused() -> None:
    short = Trajectory(stamps_ns=np.array([0, 10]), poses=np.repeat(np.eye(4)[None], 2, axis=0))

    with pytest.raises(ValueError, match="outside the trajectory"):
        deskew_along(np.zeros((2, 3)), np.array([5, 15]), short)


def test_the_gyroscope_turns_the_base_whatever_way_it_is_mounted() -> None:
    T_base_imu = SE3.exp([np.pi, 0, 0, 0, 0, 0])  # upside down
    stamps_ns = np.arange(0, 101) * 5_000_000
    rate_base = np.array([0.0, 0.0, 1.0])
    batch = ImuBatch(
        stamps_ns=stamps_ns,
        gyro_radps=np.tile(T_base_imu.R.T @ rate_base, (101, 1)),
        accel_mps2=np.zeros((101, 3)),
        T_base_sensor=T_base_imu,
    )

    motion = gyro_trajectory([batch], [2.0, 0, 0]).between(0, 500_000_000)

    np.testing.assert_allclose(motion.log()[:3], [0, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(motion.t, [1.0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_real_sweep_that_turns_is_undistorted_within_2_cm(number: int) -> None:
    """Newer College, up to 95 deg/s: its motion from half of the points, the other half is compared.

    The clouds that are given were undistorted with an IMU, which is not; so their own frame says the motion.
    """
    folder = shared("newer_college_deskew")
    seen, given = (
        np.fromfile(folder / f"{name}_{number:02d}.bin", np.float32).reshape(-1, 3).astype(float)
        for name in ("raw", "deskewed")
    )
    times_s = np.fromfile(folder / f"times_{number:02d}.bin", np.float32).astype(float)
    stamps_ns = 1_700_000_000 * 10**9 + np.rint(times_s * 1e9).astype(np.int64)
    order = np.argsort(stamps_ns, kind="stable")
    seen, given, stamps_ns = seen[order], given[order], stamps_ns[order]
    pieces = np.array_split(np.arange(0, len(seen), 2), 150)
    knots_ns = np.array([int(np.mean(stamps_ns[piece] - stamps_ns[0])) for piece in pieces])
    poses = np.array([rigid(seen[piece], given[piece]) for piece in pieces])
    trajectory = Trajectory(stamps_ns=stamps_ns[0] + knots_ns, poses=poses)
    inside = np.arange(1, len(seen), 2)
    inside = inside[[trajectory.covers(int(stamp_ns)) for stamp_ns in stamps_ns[inside]]]

    found = deskew_along(seen[inside], stamps_ns[inside], trajectory)

    assert misfit_m(found, given[inside]) < 0.005
    assert misfit_m(seen[inside], given[inside]) > 0.3


def misfit_m(source: np.ndarray, target: np.ndarray) -> float:
    """Return the rms distance of points (N, 3) from their partners, aligned as rigid bodies."""
    T = rigid(source, target)
    errors = source @ T[:3, :3].T + T[:3, 3] - target
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) that best takes points (N, 3) to their partners."""
    middle, goal = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - middle).T @ (target - goal))
    T = np.eye(4)
    T[:3, :3] = Vt.T @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ U.T
    T[:3, 3] = goal - T[:3, :3] @ middle
    return T
