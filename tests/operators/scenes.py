"""Small scenes of points on surfaces, whose places are known exactly."""

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LidarScan


def room(seed: int = 0, num_points: int = 6000, boxes: int = 12) -> FloatArray:
    """Return points (N, 3) on the walls of a hall of 16 x 12 x 4 m and on boxes in it."""
    rng = np.random.default_rng(seed)
    parts = [_box(rng, np.zeros(3), np.array([16.0, 12.0, 4.0]), num_points // 2)]
    for _ in range(boxes):
        centre = rng.uniform([-7, -5, -2], [7, 5, 1])
        parts.append(_box(rng, centre, rng.uniform(0.5, 2.5, 3), num_points // 2 // boxes))
    return np.concatenate(parts)


def corridor(seed: int = 0, num_points: int = 8000) -> FloatArray:
    """Return points on two walls and a floor that run along x: nothing says where along."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(-15, 15, num_points)
    up = rng.uniform(0, 2.5, num_points)
    side = np.where(rng.random(num_points) < 0.5, -1.2, 1.2)
    walls = np.column_stack([along, side, up])
    floor = np.column_stack([along, rng.uniform(-1.2, 1.2, num_points), np.zeros(num_points)])
    points = np.concatenate([walls[: num_points // 2], floor[num_points // 2 :]])
    return points + rng.normal(0, 0.01, points.shape)


def _box(rng: np.random.Generator, centre: FloatArray, size: FloatArray, n: int) -> FloatArray:
    points = rng.uniform(-0.5, 0.5, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.where(rng.random(n) < 0.5, -0.5, 0.5)
    return centre + points * size


def seen_from(
    world: FloatArray, T_world_sensor: SE3, seed: int, *, share: float = 0.7, noise_m: float = 0.01
) -> FloatArray:
    """Return another random part of the world's points in the sensor's frame, with noise."""
    rng = np.random.default_rng(seed)
    kept = world[rng.random(len(world)) < share]
    return T_world_sensor.inverse() @ (kept + rng.normal(0, noise_m, kept.shape))


def scan_at(points: npt.NDArray[np.floating], stamp_ns: int, **fields: object) -> LidarScan:
    return LidarScan(stamp_ns=stamp_ns, points=points.astype(np.float32), **fields)  # type: ignore[arg-type]  # of the test's choice


def drive(
    num_scans: int = 8, step: tuple[float, ...] = (0, 0, 0.03, 0.2, 0.02, 0), seed: int = 3
) -> tuple[list[LidarScan], list[SE3]]:
    """Return scans at 10 Hz of a steady motion through the hall, and the true poses."""
    world = room(seed, num_points=20000)
    poses = [SE3.exp(np.multiply(k, step)) for k in range(num_scans)]
    scans = [scan_at(seen_from(world, T, k), 10**9 + k * 10**8) for k, T in enumerate(poses)]
    return scans, poses
