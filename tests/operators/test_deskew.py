"""Motion compensation against points whose places are known."""

import numpy as np
import pytest

from mapstream.operators.lidar.deskew import deskew_along, deskew_by_velocity, gyro_trajectory
from mapstream.streams.geometry import SE3, invert, se3_exp
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.trajectory import Trajectory

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
