"""Planar scans of walls that we know, without a simulator's time."""

from __future__ import annotations

import numpy as np

from mapstream.operators.laser.planar import rotation
from mapstream.operators.laser.surfaces import Surface, surface_of
from mapstream.streams.arrays import FloatArray

ROOM = np.array(  # a room with an alcove and a pillar: walls (N, 2, 2) from end to end [m]
    [
        [[-4, -3], [5, -3]],
        [[5, -3], [5, 2]],
        [[5, 2], [3, 2]],
        [[3, 2], [3, 4]],
        [[3, 4], [-4, 4]],
        [[-4, 4], [-4, -3]],
        [[1, 0.5], [1.6, 0.5]],
        [[1.6, 0.5], [1.6, 1.1]],
        [[1.6, 1.1], [1, 1.1]],
        [[1, 1.1], [1, 0.5]],
    ],
    dtype=np.float64,
)
CORRIDOR = np.array([[[-100, -1], [100, -1]], [[-100, 1], [100, 1]]], dtype=np.float64)


def seen_from(
    pose: FloatArray,
    walls: FloatArray = ROOM,
    rng: np.random.Generator | None = None,
    num_beams: int = 181,
    noise_m: float = 0.01,
) -> FloatArray:
    """Return the beams' ends (N, 2) over half a circle and a bit, in the frame of the pose (3,) that they leave from."""
    angles = np.linspace(-2.0, 2.0, num_beams)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ends = (walls - pose[:2]) @ rotation(pose[2])
    along = ends[:, 1] - ends[:, 0]
    cross = rays[:, None, 0] * along[:, 1] - rays[:, None, 1] * along[:, 0]
    starts = ends[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (starts[:, 0] * along[:, 1] - starts[:, 1] * along[:, 0]) / cross
        on_wall = (starts[:, 0] * rays[:, None, 1] - starts[:, 1] * rays[:, None, 0]) / cross
    hit = (ranges > 0.05) & (on_wall >= 0) & (on_wall <= 1)
    nearest = np.where(hit, ranges, np.inf).min(axis=1)
    if rng is not None:
        nearest = nearest + rng.normal(0.0, noise_m, num_beams)
    keep = nearest < 20.0
    points: FloatArray = nearest[keep, None] * rays[keep]
    return points


def surface_from(
    pose: FloatArray, walls: FloatArray = ROOM, rng: np.random.Generator | None = None
) -> Surface:
    """Return what a laser sees from a pose (3,), in its frame."""
    return surface_of(seen_from(pose, walls, rng), np.zeros(2))
