"""Edits of a pose graph by hand: what edges are worth, which are on, and where vertices are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.maps.loops import touches
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import se3_exp


class Chosen(OperatorConfig):
    """Which edges are edited; an edge must meet all that is given."""

    kind: str | None = None
    source: str | None = None
    mission_row: int | None = None
    """Edges with an end in it."""
    rows: tuple[int, ...] | None = None
    """Numbers of edges, as reports name them."""


def chosen_edges(map_: Map, chosen: Chosen) -> IntArray:
    """Return the rows of the chosen edges.

    Raises:
        MapError: If there are none.
    """
    edges = map_.edges
    keep: BoolArray = np.ones(len(edges), dtype=bool)
    if chosen.kind is not None:
        keep &= edges.kind == chosen.kind
    if chosen.source is not None:
        keep &= edges.source == chosen.source
    if chosen.mission_row is not None:
        keep &= touches(map_, chosen.mission_row)
    if chosen.rows is not None:
        keep &= np.isin(np.arange(len(edges)), chosen.rows)
    rows = np.flatnonzero(keep)
    if not len(rows):
        wanted = chosen.model_dump(exclude_none=True)
        kinds = ", ".join(sorted(set(edges.kind))) or "none"
        raise MapError(f"no edge is chosen by {wanted}; the map has edges of the kinds {kinds}")
    return rows


class Uncertainty(OperatorConfig):
    """What the chosen edges are worth from now on; what is not given stays."""

    rotation_sigma_rad: PositiveFloat | None = None
    translation_sigma_m: PositiveFloat | None = None
    factor: PositiveFloat = 1.0
    """Of all standard deviations, before the above."""


def set_uncertainty(map_: Map, rows: IntArray, config: Uncertainty) -> Map:
    """Return the map with other covariances of edges; directions that were not measured stay so.

    A sigma replaces its 3x3 block, and what tied it to the other block goes.
    """
    covariance = map_.edges.covariance.copy()
    edited = covariance[rows]
    is_open = np.isinf(np.diagonal(edited, axis1=1, axis2=2))
    edited = edited * config.factor**2  # infinity stays infinity, and zero zero
    for start, sigma in ((0, config.rotation_sigma_rad), (3, config.translation_sigma_m)):
        if sigma is not None:
            block = slice(start, start + 3)
            edited[:, block, :] = edited[:, :, block] = 0.0
            edited[:, block, block] = sigma**2 * np.eye(3)
    edge, direction = np.nonzero(is_open)
    edited[edge, direction, direction] = np.inf
    covariance[rows] = edited
    return replace(map_, edges=replace(map_.edges, covariance=covariance))


class Switch(OperatorConfig):
    """What an optimizer is told of the chosen edges; what is not given stays."""

    value: float | None = Field(default=None, ge=0, le=1)
    """0: false, 1: true."""
    variance: NonNegativeFloat | None = None
    is_switchable: bool | None = None
    """Whether an optimizer may find that an edge is false."""


def set_switch(map_: Map, rows: IntArray, config: Switch) -> Map:
    """Return the map with other switches of edges."""
    edited = {}
    for column, value in (
        ("switch", config.value),
        ("switch_variance", config.variance),
        ("is_switchable", config.is_switchable),
    ):
        if value is not None:
            values = getattr(map_.edges, column).copy()
            values[rows] = value
            edited[column] = values
    return replace(map_, edges=replace(map_.edges, **edited))


class Disturbance(OperatorConfig):
    """How far vertices are moved, and by which random numbers."""

    rotation_sigma_rad: NonNegativeFloat = 0.01
    translation_sigma_m: NonNegativeFloat = 0.1
    seed: int = Field(default=0, ge=0)


def disturb(map_: Map, config: Disturbance, mission_row: int | None = None) -> Map:
    """Return the map with noise on its poses: all, or one mission's; the first of each mission stays."""
    rng = np.random.default_rng(config.seed)
    sigmas = np.repeat([config.rotation_sigma_rad, config.translation_sigma_m], 3)
    poses = map_.vertices.T_mission_base.copy()
    for row in range(len(map_.missions)) if mission_row is None else [mission_row]:
        moved = map_.vertices_of(row)[1:]
        poses[moved] = poses[moved] @ se3_exp(rng.normal(size=(len(moved), 6)) * sigmas)
    return replace(map_, vertices=replace(map_.vertices, T_mission_base=poses))
