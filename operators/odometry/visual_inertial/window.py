"""What was seen from the clones: one row per keypoint, grouped by the point when it is wanted."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from mapstream.operators.odometry.visual.rays import Rays
from mapstream.operators.odometry.visual.triangulation import Views
from mapstream.operators.odometry.visual_inertial.state import FilterState
from mapstream.streams.arrays import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]
_LEAST_VIEWS = 3  # of a track that is used


@dataclass(slots=True, eq=False)
class Sightings:
    """Keypoints of points: whose, from which clone, in which direction."""

    keys: IntArray  # (N,)
    clone_ids: IntArray  # (N,)
    rays: FloatArray  # (N, 3) unit, in the IMU's frame
    weights: FloatArray  # (N, 2, 3) of `Rays`, for directions in the IMU's frame
    offsets: FloatArray  # (N, 3) [m] of the camera from the IMU, in its frame

    @classmethod
    def none(cls) -> Sightings:
        shapes = ((0, 3), (0, 2, 3), (0, 3))
        empty = np.empty(0, np.int64)
        return cls(empty, empty, *(np.empty(shape) for shape in shapes))

    @classmethod
    def of(cls, rays: Rays, clone_id: int, T_imu_base: FloatArray) -> Sightings:
        """Return what one n-frame shows, seen from the IMU."""
        T_imu_camera = (T_imu_base @ rays.mounts)[rays.cameras]
        R = T_imu_camera[:, :3, :3]
        return cls(
            rays.keys,
            np.full(len(rays), clone_id),
            np.einsum("nij,nj->ni", R, rays.rays),
            rays.weights @ np.swapaxes(R, 1, 2),
            T_imu_camera[:, :3, 3],
        )

    def chosen(self, which: BoolArray | IntArray) -> Sightings:
        return Sightings(*(getattr(self, each.name)[which] for each in fields(self)))

    def joined(self, other: Sightings) -> Sightings:
        pairs = [(getattr(self, each.name), getattr(other, each.name)) for each in fields(self)]
        return Sightings(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True, slots=True, eq=False)
class Grouped:
    """Sightings of F points, at most M of each."""

    keys: IntArray  # (F,)
    views: Views
    clones: IntArray  # (F, M) index of the clone in the state; -1: unused


def grouped(sightings: Sightings, state: FilterState) -> Grouped:
    """Return the sightings by point, in the odom frame, the earliest first."""
    keys, point, counts = np.unique(sightings.keys, return_inverse=True, return_counts=True)
    clone = np.searchsorted(state.clone_ids, sightings.clone_ids)
    order = np.lexsort((clone, point))
    slot = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    at = (point[order], slot)
    shape = (len(keys), int(counts.max(initial=1)))
    R = state.clone_R[clone[order]]
    centres = state.clone_p[clone[order]] + np.einsum("nij,nj->ni", R, sightings.offsets[order])
    all_centres = np.repeat(centres[slot == 0][:, None], shape[1], axis=1)
    all_centres[at] = centres
    rows = np.zeros((*shape, 2, 3))
    rows[at] = sightings.weights[order] @ np.swapaxes(R, 1, 2)
    clones = np.full(shape, -1)
    clones[at] = clone[order]
    first = np.einsum("nij,nj->ni", R, sightings.rays[order])[slot == 0]
    return Grouped(keys, Views(rows, all_centres, first, counts), clones)


def complete(
    sightings: Sightings, keys_now: IntArray, oldest_id: int | None, most: int
) -> tuple[IntArray, IntArray]:
    """Return the keys of tracks whose time has come, and of those that will not be needed any more.

    A track's time has come when its point is lost, or when it reaches back to the oldest clone of a full window.
    If those are too many the longest are used; of the others those that go on wait for the next image.

    Args:
        sightings: Of the window.
        keys_now: Points that are seen now.
        oldest_id: Of a full window; None if it is not full.
        most: So many are used.
    """
    keys, point, counts = np.unique(sightings.keys, return_inverse=True, return_counts=True)
    is_lost = ~np.isin(keys, keys_now)
    is_due = is_lost.copy()
    if oldest_id is not None:
        is_due[point[sightings.clone_ids == oldest_id]] = True
    due = np.flatnonzero(is_due & (counts >= _LEAST_VIEWS))
    used = due[np.lexsort((keys[due], -counts[due]))[:most]]
    return keys[used], np.union1d(keys[used], keys[is_lost])
