"""What was seen from a window of images: one row per keypoint, grouped by the point when it is wanted."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from mapstream.operators.odometry.visual.rays import Rays
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Who saw each of F points, and where: at most M views of a point, unused ones with weight zero.

    All in one frame, the world. `rows` is the weight of `rays.Rays` turned into it: a point f has the
    residual rows @ (f - centres) / |f - centres|.
    """

    rows: FloatArray  # (F, M, 2, 3)
    centres: FloatArray  # (F, M, 3) [m]; of unused views that of the first one
    first: FloatArray  # (F, 3) unit direction in which the first view sees the point
    counts: IntArray  # (F,)
    distances: FloatArray | None  # (F, M) [m] that the sensor measured; None if it measured none
    distance_weights: FloatArray | None  # (F, M) [1/m]; zero where there is none

    @property
    def freedom(self) -> IntArray:
        """Return by how many (F,) the measurements exceed the three unknowns of a point."""
        free = 2 * self.counts - 3
        if self.distance_weights is not None:
            free = free + (self.distance_weights > 0).sum(axis=1)
        return np.asarray(free)


@dataclass(slots=True, eq=False)
class Sightings:
    """Keypoints of points: whose, from which image, in which direction; a body carries the cameras."""

    keys: IntArray  # (N,)
    images: IntArray  # (N,) number of the image
    rays: FloatArray  # (N, 3) unit, in the body's frame
    weights: FloatArray  # (N, 2, 3) of `Rays`, for directions in the body's frame
    offsets: FloatArray  # (N, 3) [m] of the camera from the body, in its frame
    distances: FloatArray  # (N,) [m]; NaN: not measured
    distance_sigmas: FloatArray  # (N,) [m]

    @classmethod
    def none(cls) -> Sightings:
        shapes = ((0, 3), (0, 2, 3), (0, 3), (0,), (0,))
        empty = np.empty(0, np.int64)
        return cls(empty, empty, *(np.empty(shape) for shape in shapes))

    @classmethod
    def of(cls, rays: Rays, image: int, T_body_base: FloatArray) -> Sightings:
        """Return what one n-frame shows, seen from the body."""
        T_body_camera = (T_body_base @ rays.mounts)[rays.cameras]
        R = T_body_camera[:, :3, :3]
        return cls(
            rays.keys,
            np.full(len(rays), image),
            np.einsum("nij,nj->ni", R, rays.rays),
            rays.weights @ np.swapaxes(R, 1, 2),
            T_body_camera[:, :3, 3],
            rays.distances,
            rays.distance_sigmas,
        )

    def chosen(self, which: BoolArray | IntArray) -> Sightings:
        return Sightings(*(getattr(self, each.name)[which] for each in fields(self)))

    def joined(self, other: Sightings) -> Sightings:
        pairs = [(getattr(self, each.name), getattr(other, each.name)) for each in fields(self)]
        return Sightings(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.keys)

    def without_far_pairs(self, most_baselines: float) -> Sightings:
        """Return the sightings of one image, of points beyond so many baselines only the first camera's.

        A pair's calibration errs by some tenth of a pixel, always to the same side. Near points hardly notice;
        of far ones many images would average to a distance that is certain and wrong.
        """
        order = np.argsort(self.keys, kind="stable")
        again = np.zeros(len(self), bool)
        again[1:] = self.keys[order][1:] == self.keys[order][:-1]
        second, first = order[again], order[np.flatnonzero(again) - 1]
        parallax = np.linalg.norm(self.rays[second] - self.rays[first], axis=1)
        kept = np.ones(len(self), bool)
        kept[second[parallax * most_baselines < 1]] = False
        return self.chosen(kept)


@dataclass(frozen=True, slots=True, eq=False)
class Grouped:
    """Sightings of F points, at most M of each."""

    keys: IntArray  # (F,)
    views: Views
    images: IntArray  # (F, M) index of the image's pose; -1: unused


def grouped(sightings: Sightings, images: IntArray, R: FloatArray, p: FloatArray) -> Grouped:
    """Return the sightings by point, in the world, the earliest first.

    Args:
        sightings: Of these images.
        images: (K,) increasing.
        R: (K, 3, 3) R_world_body at the images.
        p: (K, 3) of the body [m].
    """
    keys, point, counts = np.unique(sightings.keys, return_inverse=True, return_counts=True)
    image = np.searchsorted(images, sightings.images)
    order = np.lexsort((image, point))
    slot = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    at = (point[order], slot)
    shape = (len(keys), int(counts.max(initial=1)))
    turn = R[image[order]]
    centres = p[image[order]] + np.einsum("nij,nj->ni", turn, sightings.offsets[order])
    all_centres = np.repeat(centres[slot == 0][:, None], shape[1], axis=1)
    all_centres[at] = centres
    rows = np.zeros((*shape, 2, 3))
    rows[at] = sightings.weights[order] @ np.swapaxes(turn, 1, 2)
    used = np.full(shape, -1)
    used[at] = image[order]
    first = np.einsum("nij,nj->ni", turn, sightings.rays[order])[slot == 0]
    distances, weights = _distances(sightings, order, at, shape)
    return Grouped(keys, Views(rows, all_centres, first, counts, distances, weights), used)


def _distances(
    sightings: Sightings, order: IntArray, at: tuple[IntArray, IntArray], shape: tuple[int, int]
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return measured distances and their weights, both of the shape, or None if nothing was measured."""
    measured = sightings.distances[order]
    is_known = np.isfinite(measured)
    if not is_known.any():
        return None, None
    distances, weights = np.zeros(shape), np.zeros(shape)
    distances[at] = np.where(is_known, measured, 0)
    weights[at] = np.where(is_known, 1 / sightings.distance_sigmas[order], 0)
    return distances, weights
