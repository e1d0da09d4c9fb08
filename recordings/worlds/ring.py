"""The centre line of a ring of corridors: a rectangle with round corners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray

MIN_LENGTH_M = 36.0  # below it the corners leave no room for the corridor's inner wall
_MAX_RADIUS_M = 8.0
_LONG_SHARE = 0.35  # of the straight parts lies in each long side


class Ring:
    """Points and headings at distances along the line, which starts amid a long side along x."""

    def __init__(self, length_m: float) -> None:
        self.radius_m = min(_MAX_RADIUS_M, length_m / 8)  # of the corners
        arc = np.pi / 2 * self.radius_m
        straight = length_m - 4 * arc
        long, short = straight * _LONG_SHARE, straight * (0.5 - _LONG_SHARE)
        lengths = np.array([long / 2, arc, short, arc, long, arc, short, arc, long / 2])
        self.length_m = length_m
        self._curvature = np.array([0, 1, 0, 1, 0, 1, 0, 1, 0]) / self.radius_m  # [1/m]
        self._starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        self._headings = np.concatenate([[0.0], np.cumsum(lengths * self._curvature)[:-1]])
        parts = _advance(lengths, self._curvature, self._headings)
        self._origins = np.concatenate([[[0.0, 0.0]], np.cumsum(parts, axis=0)[:-1]])

    def _part(self, s_m: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray]:
        """Return which line or arc each distance lies on, and how far along it [m]."""
        wrapped = np.mod(s_m, self.length_m)
        part = np.searchsorted(self._starts, wrapped, side="right") - 1
        return part, wrapped - self._starts[part]

    def curvature(self, s_m: FloatArray) -> FloatArray:
        """Return the curvature [1/m] at distances of any shape."""
        curvature: FloatArray = self._curvature[self._part(s_m)[0]]
        return curvature

    def headings(self, s_m: FloatArray) -> FloatArray:
        """Return headings [rad] at distances of any shape; they grow by a full turn with every lap."""
        part, along = self._part(s_m)
        laps = np.floor(s_m / self.length_m)
        headings: FloatArray = (
            2 * np.pi * laps + self._headings[part] + self._curvature[part] * along
        )
        return headings

    def points(self, s_m: FloatArray, left_m: npt.ArrayLike, up_m: npt.ArrayLike) -> FloatArray:
        """Return points (..., 3) [m]: `left_m` beside the line at `s_m`, `up_m` over the floor."""
        s_m, left_m, up_m = np.broadcast_arrays(s_m, left_m, up_m)
        part, along = self._part(s_m)
        xy = self._origins[part] + _advance(along, self._curvature[part], self._headings[part])
        heading = self._headings[part] + self._curvature[part] * along
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        return np.concatenate([xy + left_m[..., None] * left, up_m[..., None]], axis=-1)


def _advance(along: FloatArray, curvature: FloatArray, heading: FloatArray) -> FloatArray:
    """Return the displacement (..., 2) after `along` metres of a line or an arc."""
    half_turn = curvature * along / 2
    chord = along * np.sinc(half_turn / np.pi)
    direction = heading + half_turn
    return np.stack([chord * np.cos(direction), chord * np.sin(direction)], axis=-1)
