"""Robots that stood still: tight edges where a stretch of vertices did not move, so that noise does not drift.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-C (stationary submaps).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert, so3_log

SOURCE = "stationary"


class StationaryConfig(OperatorConfig):
    """When a robot counts as standing, and what that is worth."""

    max_distance_m: PositiveFloat = 0.10
    max_angle_rad: PositiveFloat = 0.15
    stretch: PositiveInt = 1
    """Vertices from one end of a stretch to the other; that of submaps, for instance."""
    rotation_sigma_rad: PositiveFloat = 1e-3
    translation_sigma_m: PositiveFloat = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class StationaryReport:
    """What was found."""

    num_stretches: int
    num_standing: int  # stretches that got an edge


def fix_stationary(
    map_: Map, config: StationaryConfig | None = None
) -> tuple[Map, StationaryReport]:
    """Return the map with a tight edge "did not move" over each stretch in which a robot stood still.

    A stretch stands if the poses at its ends differ by less than both limits. Edges of an earlier call go.
    """
    config = config or StationaryConfig()
    map_ = map_.select(edges=map_.edges.source != SOURCE)
    ends = [_stretches(map_, row, config.stretch) for row in range(len(map_.missions))]
    starts, stops = np.concatenate([np.empty((2, 0), np.int64), *ends], axis=1)
    distance_m, angle_rad = _moved(map_, starts, stops)
    stands = (distance_m < config.max_distance_m) & (angle_rad < config.max_angle_rad)
    sigmas = np.repeat([config.rotation_sigma_rad, config.translation_sigma_m], 3)
    num = int(stands.sum())
    tight = Edges(
        kind=np.full(num, MOTION_KINDS[-1], dtype=object),
        vertex_a=starts[stands],
        vertex_b=stops[stands],
        T_a_b=np.tile(np.eye(4), (num, 1, 1)),
        covariance=np.tile(np.diag(sigmas**2), (num, 1, 1)),
        source=np.full(num, SOURCE, dtype=object),
    )
    report = StationaryReport(num_stretches=len(starts), num_standing=num)
    return append_edges(map_, tight), report


def _stretches(map_: Map, mission_row: int, stretch: int) -> IntArray:
    """Return rows of vertices (2, N) where stretches of a mission begin and end; the last may be shorter."""
    rows = map_.vertices_of(mission_row)
    at = np.unique(np.append(np.arange(0, len(rows), stretch), max(len(rows) - 1, 0)))
    cuts = rows[at[at < len(rows)]]
    return np.stack([cuts[:-1], cuts[1:]])


def _moved(map_: Map, starts: IntArray, stops: IntArray) -> tuple[FloatArray, FloatArray]:
    poses = map_.vertices.T_mission_base
    motion = invert(poses[starts]) @ poses[stops]
    distance_m: FloatArray = np.linalg.norm(motion[:, :3, 3], axis=1)
    angle_rad: FloatArray = np.linalg.norm(so3_log(motion[:, :3, :3]), axis=1)
    return distance_m, angle_rad
