"""Loop edges between clusters of objects: which vertices they join, and how sure they are.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.objects.loops.alignment_covariance import alignment_covariance
from mapstream.operators.objects.loops.horn import horn
from mapstream.operators.objects.loops.placed_objects import PlacedObjects, ways_m, weights
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert

SOURCE = "semantic_loops"


class EdgeConfig(OperatorConfig):
    """What an edge between two clusters joins, and is worth."""

    vertices: Literal["closest", "topological_center"] = "closest"
    """Of those that see a cluster: the nearest one, or the one with the shortest way to all others."""
    sigma_rotation_rad: PositiveFloat = 0.01
    """Uncertainty that every loop has beyond that of the objects."""
    sigma_translation_m: PositiveFloat = 0.02
    """The same of the position."""
    drift_m_per_m: NonNegativeFloat = 0.03
    """The same for each metre between a vertex and its cluster: odometry that drifts stretches what it measures."""
    max_sigma_rad: PositiveFloat = 0.35
    """A loop whose rotation is less sure about some axis is none: its objects lie nearly on a line."""
    switch_variance: NonNegativeFloat = 1e-8
    """Of the switch by which an optimizer may turn the edge off."""


def cluster_vertex(
    map_: Map, objects: PlacedObjects, cluster: IntArray, allowed: IntArray, config: EdgeConfig
) -> int:
    """Return the vertex that stands for a cluster of objects, among those that see one of them.

    Args:
        map_: The map.
        objects: All objects.
        cluster: Some of them, by their places.
        allowed: Vertices that may be chosen, where one of them sees the cluster.
        config: Which one.
    """
    seeing = np.unique(np.concatenate([objects.vertices[n] for n in cluster.tolist()]))
    seeing = np.intersect1d(seeing, allowed)
    if config.vertices == "closest":
        at = map_.T_map_base(seeing)[:, :3, 3]
        cost = np.linalg.norm(at - objects.positions[cluster].mean(axis=0), axis=1)
    else:
        way_m = ways_m(map_)[seeing]
        cost = np.abs(way_m[:, None] - way_m).sum(axis=1)
    return int(seeing[np.argmin(cost)])


def semantic_edge(
    map_: Map, objects: PlacedObjects, ends: tuple[int, int], pairs: IntArray, config: EdgeConfig
) -> Edges:
    """Return the edge between two vertices by the objects that both places have in common.

    Args:
        map_: The map.
        objects: All objects.
        ends: The vertex of either place.
        pairs: Objects (2, N) of either place, by their places; they are the same.
        config: What it is worth.

    Raises:
        EstimationError: If the objects do not determine how the places are turned.
    """
    T_ends_map = invert(map_.T_map_base(np.array(ends)))
    (a, C_a), (b, C_b) = (_in_frame(T, objects, n) for T, n in zip(T_ends_map, pairs, strict=True))
    w = weights(objects, *pairs)
    T_a_b = horn(a, b, w)
    covariance = alignment_covariance(T_a_b, a, b, C_a, C_b, w)
    sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    if sigma_rad > config.max_sigma_rad:
        raise EstimationError(
            f"its objects lie nearly on a line: {np.rad2deg(sigma_rad):.0f} degrees unsure about it"
        )
    away_m = np.linalg.norm(
        [points.mean(axis=0) for points in (a, b)]
    )  # both, root of the sum of squares
    sigma_m = np.hypot(config.sigma_translation_m, config.drift_m_per_m * away_m)
    floor = np.repeat([config.sigma_rotation_rad, sigma_m], 3) ** 2
    return Edges(
        kind=np.array(["loop"], object),
        vertex_a=np.array(ends[:1]),
        vertex_b=np.array(ends[1:]),
        T_a_b=T_a_b[None],
        covariance=(covariance + np.diag(floor))[None],
        is_switchable=np.array([True]),
        switch_variance=np.array([config.switch_variance]),
        source=np.array([SOURCE], object),
    )


def _in_frame(
    T: FloatArray, objects: PlacedObjects, rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return where objects are in another frame than the map's, and how surely."""
    R = T[:3, :3]
    return objects.positions[rows] @ R.T + T[:3, 3], R @ objects.covariances[rows] @ R.T
