"""From the edges of a map to gtsam's factors, by the edge's kind.

A kind registers a function; maps keep edges of kinds that nobody registered, and the solvers report them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.noise import NoiseModels
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.messages.sensors import FloatArray

Factor = Any  # gtsam has no types
Maker = Callable[[Edges, int, Any], Factor]  # edges, row, noise -> factor on the keys = vertex rows


def _between(edges: Edges, row: int, noise: Any) -> Factor:  # noqa: ANN401
    key_a, key_b = int(edges.vertex_a[row]), int(edges.vertex_b[row])
    return gtsam.BetweenFactorPose3(key_a, key_b, gtsam.Pose3(edges.T_a_b[row]), noise)


def _absolute(edges: Edges, row: int, noise: Any) -> Factor:  # noqa: ANN401
    """The edge's transform is T_map_base."""
    return gtsam.PriorFactorPose3(int(edges.vertex_a[row]), gtsam.Pose3(edges.T_a_b[row]), noise)


MAKERS: dict[str, Maker] = {
    "odometry": _between,
    "wheel": _between,
    "registration": _between,
    "motion_model": _between,
    "loop": _between,
    "absolute": _absolute,
}


def register(kind: str, maker: Maker) -> None:
    """Make a kind of edges known to the solvers.

    Raises:
        ValueError: If the kind is taken.
    """
    if kind in MAKERS:
        raise ValueError(f"edges of kind {kind!r} have a maker already")
    MAKERS[kind] = maker


def make_factors(edges: Edges, rows: Iterable[int], noise_of: NoiseModels) -> dict[int, Factor]:
    """Return a factor for each row whose kind is known; keys of poses are rows of vertices.

    Raises:
        EstimationError: If a covariance is not one.
    """
    return {
        row: MAKERS[edges.kind[row]](edges, row, noise_of(edges.covariance[row]))
        for row in rows
        if edges.kind[row] in MAKERS
    }


def values_from(poses: FloatArray) -> Any:  # noqa: ANN401
    """Return gtsam's values with a pose (4, 4) of each row, under the row's number."""
    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    return values


def poses_from(values: Any, num_poses: int) -> FloatArray:  # noqa: ANN401
    """Return poses (N, 4, 4) of the values under the keys 0 to N - 1."""
    rows = gtsam.utilities.extractPose3(values)  # (N, 12) by key: R by rows, then t
    poses = np.tile(np.eye(4), (num_poses, 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses


def fixed(key: int, pose: FloatArray) -> Factor:
    """Return the factor that holds one pose where it is."""
    exactly = gtsam.noiseModel.Constrained.All(6)
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), exactly)
