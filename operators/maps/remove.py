"""Parts of a map taken out, so that what stays is a map.

What a robot measured of its motion through a gap is composed into one edge over it; IMU samples are joined.
Where nothing was measured through the gap, or that is wanted, the mission ends there and another one begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import model_validator

from mapstream.operators.maps.landmark_homes import rehomed, without_vertices
from mapstream.operators.maps.linking import linked
from mapstream.operators.maps.split import split_mission
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.combine import select_missions
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.structure_rules import components
from mapstream.streams.errors import MapError

_MAX_NS = 2**63 - 1


class Gap(OperatorConfig):
    """What is taken out of a mission, and what becomes of the gap."""

    start_ns: int = 0
    end_ns: int = _MAX_NS
    """The last stamp that goes."""
    across: Literal["link", "split"] = "link"
    """link: edges lead over the gap, where something was measured; split: what follows is another mission."""

    @model_validator(mode="after")
    def _is_a_span(self) -> Gap:
        if self.start_ns > self.end_ns:
            raise ValueError(f"starts at {self.start_ns} ns, after its end at {self.end_ns} ns")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovalReport:
    """What went, and how the gap was closed."""

    num_vertices: int  # that went
    num_links: int = 0  # edges that now lead over the gap
    new_missions: tuple[str, ...] = ()  # ids of missions that begin after the gap


def remove_missions(map_: Map, mission_rows: Sequence[int]) -> tuple[Map, RemovalReport]:
    """Return the map without some missions; landmarks that others see stay.

    Raises:
        MapError: If no mission would be left.
    """
    goes = np.isin(np.arange(len(map_.missions)), mission_rows)
    if goes.all():
        raise MapError("all missions would go; remove the map's folder instead")
    rest = [map_.mission_id(row) for row in np.flatnonzero(~goes).tolist()]
    kept = rehomed(map_, ~goes[map_.vertices.mission])
    num_vertices = int(goes[map_.vertices.mission].sum())
    return select_missions(kept, rest), RemovalReport(num_vertices=num_vertices)


def remove_range(map_: Map, mission_row: int, gap: Gap) -> tuple[Map, RemovalReport]:
    """Return the map without a mission's vertices from one stamp to another.

    Raises:
        MapError: If there is no vertex in that time, or none outside.
    """
    rows = map_.vertices_of(mission_row)
    stamps_ns = map_.vertices.stamp_ns[rows]
    goes = (stamps_ns >= gap.start_ns) & (stamps_ns <= gap.end_ns)
    name = map_.mission_id(mission_row)
    if not goes.any():
        raise MapError(f"mission {name} has no vertex from {gap.start_ns} to {gap.end_ns} ns")
    if goes.all():
        raise MapError(f"nothing of mission {name} would be left; remove the mission")
    first, last = np.flatnonzero(goes)[[0, -1]]
    is_inside = first > 0 and last < len(rows) - 1
    over, num_links, new = map_, 0, tuple[str, ...]()
    if is_inside and gap.across == "link":
        over, num_links = linked(map_, [rows[first - 1 : last + 2]])
    keep = np.ones(len(map_.vertices), dtype=bool)
    keep[rows[goes]] = False
    left = without_vertices(over, keep)
    if is_inside and gap.across == "split":
        left, mission_id = split_mission(left, mission_row, int(stamps_ns[last + 1]))
        new = (mission_id,)
    else:
        left, new = _split_where_apart(left, mission_row)
    return left, RemovalReport(num_vertices=int(goes.sum()), num_links=num_links, new_missions=new)


def _split_where_apart(map_: Map, mission_row: int) -> tuple[Map, tuple[str, ...]]:
    """Return the map with a mission for each piece of one that nothing joins any more."""
    new = list[str]()
    while True:
        rows = map_.vertices_of(mission_row)
        part = components(map_)[rows]
        breaks = np.flatnonzero(part != part[0])
        if not len(breaks):
            return map_, tuple(new)
        starts_ns = int(map_.vertices.stamp_ns[rows[breaks[0]]])
        map_, mission_id = split_mission(map_, mission_row, starts_ns)
        new.append(mission_id)
        mission_row = map_.mission_row(mission_id)
