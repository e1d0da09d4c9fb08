"""Kinds of edges: who turns them into factors.

A maker takes all rows of its kind at once, so that what they share is worked out once.
Maps keep edges of kinds that nobody registered, and the solvers report them.
A package adds kinds by entry points of the group `mapstream.factors`: the name is the kind, the object its maker.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import entry_points

import numpy as np

from mapstream.operators.estimation.factors import (
    absolute,
    inertial,
    landmarks,
    relations,
    relative,
)
from mapstream.operators.estimation.factors.edge_ends import edge_name
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import EstimationError

Maker = Callable[[Map, IntArray, NoiseModels], dict[int, Factor]]
"""From a map and rows of its edges of one kind to a factor by row, on the keys of `keys.py`."""

GROUP = "mapstream.factors"
_BUILT_IN: dict[str, Maker] = {
    "odometry": relative.between,
    "wheel": relative.between,
    "registration": relative.between,
    "motion_model": relative.between,
    "loop": relative.between,
    "absolute": absolute.pose,
    "position": absolute.position,
    "gravity": absolute.gravity,
    "fixed": absolute.fixed,
    "range": landmarks.distance,
    "landmark": landmarks.seen,
    "plane": landmarks.seen,
    "point_on_plane": relations.point_on_plane,
    "parallel": relations.parallel,
    "perpendicular": relations.perpendicular,
    "coplanar": relations.coplanar,
    "imu": inertial.imu,
}
_registered: dict[str, Maker] = {}


def register(kind: str, maker: Maker) -> None:
    """Make a kind of edges known to the solvers of this process.

    Raises:
        ValueError: If the kind is taken.
    """
    if kind in makers():
        raise ValueError(f"edges of kind {kind!r} have a maker already")
    _registered[kind] = maker


def makers() -> Mapping[str, Maker]:
    """Return the makers by kind: those built in, those of installed packages, and those registered."""
    return {**_installed(), **_registered, **_BUILT_IN}


@cache
def _installed() -> dict[str, Maker]:
    """Read the entry points, once per process.

    Raises:
        EstimationError: If one cannot be loaded; it names the package.
    """
    found = {}
    for point in entry_points(group=GROUP):
        try:
            found[point.name] = point.load()
        except (ImportError, AttributeError) as error:
            package = point.dist.name if point.dist else "unknown"
            raise EstimationError(
                f"the kind of edges {point.name!r} of package {package} cannot be loaded: {error}"
            ) from error
    return found


def make_factors(
    map_: Map, rows: IntArray | Sequence[int], noise_of: NoiseModels
) -> dict[int, Factor]:
    """Return a factor for each of these rows of edges whose kind is known, in the order of rows.

    Raises:
        EstimationError: If an edge lacks what its kind needs, or its covariance is not one.
    """
    rows = np.asarray(rows, dtype=np.int64)
    undefined = rows[~np.isfinite(map_.edges.T_a_b[rows]).all(axis=(1, 2))]
    if len(undefined):  # gtsam would end without a word, having done nothing
        raise EstimationError(f"{edge_name(map_, int(undefined[0]))}: its transform is not finite")
    known = makers()
    made: dict[int, Factor] = {}
    kind_of_row = map_.edges.kind[rows]
    for kind in sorted(set(kind_of_row) & set(known)):
        made.update(known[kind](map_, rows[kind_of_row == kind], noise_of))
    return dict(sorted(made.items()))
