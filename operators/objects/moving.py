"""Which things move: their middles go farther than they are unsure, and their points do not come to lie where they lay.

The second question keeps what stands: from elsewhere one sees another part of it, and the middle of what is seen goes.
From the other side one sees other points, too, but their middle is no farther away than the thing is large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

_LEAST_REACH_M = 0.05
_REACH_SHARE = 0.1  # of its size: so near lie points of one surface that was seen twice
_JUMP = 0.6  # of its way; a thing that moves makes no such step at once
_OTHER_SIDE_RAD = np.deg2rad(45)  # from so far round one sees other sides of a thing
_SIDES = 2  # sightings on each side of one whose middles are smoothed


class MovingConfig(OperatorConfig):
    """When a thing moves."""

    min_distance_m: PositiveFloat = 0.3
    """Which its middle must go."""
    min_sigma: PositiveFloat = 2.0
    """The same, in standard deviations of both places."""
    max_overlap: float = Field(default=0.4, ge=0, le=1)
    """Of its points, no more may lie where some of it lay before."""
    min_sightings: PositiveInt = 4


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """One thing at several times, in a frame that stands."""

    stamps_ns: IntArray  # (N,) rising
    centers: FloatArray  # (N, 3) [m]
    sigmas_m: FloatArray  # (N,)
    eyes: FloatArray  # (N, 3) where the camera was
    points: tuple[Float32Array, ...]  # N of (K, 3)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def center_at(self, stamp_ns: int) -> FloatArray:
        """Return its middle at a time; before and after that of the ends."""
        return np.array([np.interp(stamp_ns, self.stamps_ns, axis) for axis in self.centers.T])


def is_moving(path: Path, config: MovingConfig) -> bool:
    """Return whether a thing moved between some two of its sightings; what is not sure stands."""
    if len(path) < config.min_sightings:
        return False
    middles = _smoothed(path.centers)
    apart_m = np.linalg.norm(middles[:, None] - middles[None], axis=2)
    a, b = np.sort(np.unravel_index(apart_m.argmax(), apart_m.shape)).tolist()
    unsure_m = config.min_sigma * np.hypot(path.sigmas_m[a], path.sigmas_m[b])
    if apart_m[a, b] <= max(config.min_distance_m, unsure_m):
        return False
    if _is_jump(middles[a : b + 1], path.stamps_ns[a : b + 1]):
        return False
    ends = [path.points[_most_typical(path, middles[end])] for end in (a, b)]
    is_other_side = _turned_rad(path.eyes[[a, b]] - middles[[a, b]]) > _OTHER_SIDE_RAD
    if is_other_side and apart_m[a, b] <= max(_longest_m(end) for end in ends):
        return False
    return overlap(*ends) <= config.max_overlap


def _turned_rad(views: FloatArray) -> float:
    """Return the angle between two directions (2, 3) from which a thing was seen."""
    a, b = views
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _is_jump(middles: FloatArray, stamps_ns: IntArray) -> bool:
    """Return whether most of the way was made at once: then the tracker went over to another thing."""
    way = middles[-1] - middles[0]
    steps = np.diff(middles @ way) / float(way @ way)
    times = np.diff(stamps_ns)
    return bool((steps > np.maximum(_JUMP, 2 * times / times.sum())).any())


def _most_typical(path: Path, middle: FloatArray) -> int:
    """Return the sighting whose own middle is nearest to a smoothed one."""
    return int(np.linalg.norm(path.centers - middle, axis=1).argmin())


def _longest_m(points: Float32Array) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def overlap(a: Float32Array, b: Float32Array) -> float:
    """Return the share of the points of one (N, 3) that lie beside points of the other (M, 3): of both the larger."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # takes long to import

    if not (len(a) and len(b)):
        return 0.0
    reach_m = max(_LEAST_REACH_M, _REACH_SHARE * min(_longest_m(a), _longest_m(b)))
    near: list[BoolArray] = [
        cKDTree(one).query(other, distance_upper_bound=reach_m)[0] <= reach_m
        for one, other in ((a, b), (b, a))
    ]
    return max(float(each.mean()) for each in near)


def _smoothed(centers: FloatArray) -> FloatArray:
    """Return medians (N, 3) along time, so that one wrong mask is no motion."""
    padded = np.pad(centers, ((_SIDES, _SIDES), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _SIDES + 1, axis=0)
    smoothed: FloatArray = np.median(windows, axis=2)
    return smoothed
