"""Loop closures that came from elsewhere: put into a map between its vertices, and taken out again.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A1 (external loop closures).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapstream.operators.maps.external_loops import End, edge_between, end_at
from mapstream.operators.maps.missions import find_mission
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import RelativePose
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopsReport:
    """What became of loops from elsewhere."""

    num_added: int
    left_out: dict[str, int] = field(default_factory=dict)  # by the reason


def close_loops(map_: Map, loops: Sequence[RelativePose]) -> tuple[Map, LoopsReport]:
    """Return the map with loops as edges between the nearest vertices, and what became of each.

    A loop may join any instants of missions; the motion between an instant and its nearest vertex is that of
    the map's trajectory. Loops outside the missions, or with both ends at one vertex, are left out.

    Args:
        map_: The map.
        loops: Their missions are named by id, by its first digits, or by name.
    """
    finder = _Ends(map_)
    added, left_out = list[RelativePose](), dict[str, int]()
    for loop in loops:
        try:
            added.append(finder.between_vertices(loop))
        except MapError as error:
            left_out[str(error)] = left_out.get(str(error), 0) + 1
    return add_edges(map_, added), LoopsReport(num_added=len(added), left_out=left_out)


class _Ends:
    """Finds the vertices at the ends of loops."""

    def __init__(self, map_: Map) -> None:
        self._map = map_
        self._rows: dict[str, int] = {}  # of missions, by what loops call them
        self._trajectories: dict[int, Trajectory] = {}

    def between_vertices(self, loop: RelativePose) -> RelativePose:
        """Return the loop from vertex to vertex.

        Raises:
            MapError: If an end lies outside its mission, or both lie at one vertex.
        """
        a = self._end(loop.mission_a, loop.stamp_a_ns)
        return edge_between(loop, a, self._end(loop.mission_b, loop.stamp_b_ns))

    def _end(self, mission: str, stamp_ns: int) -> End:
        if mission not in self._rows:
            self._rows[mission] = find_mission(self._map, mission)
        row = self._rows[mission]
        mission_id = self._map.mission_id(row)
        if row not in self._trajectories:
            self._trajectories[row] = self._map.trajectory(mission_id)
        return end_at(mission_id, self._trajectories[row], stamp_ns)


def delete_loops(
    map_: Map, *, kinds: Iterable[str] = ("loop",), mission_row: int | None = None, source: str = ""
) -> tuple[Map, int]:
    """Return the map without its loop closures, and how many they were; poses stay.

    Args:
        map_: The map.
        kinds: Of the edges that go.
        mission_row: Only edges with an end in this mission.
        source: Only edges of this source.
    """
    goes = np.isin(map_.edges.kind, list(kinds))
    if source:
        goes &= map_.edges.source == source
    if mission_row is not None:
        goes &= touches(map_, mission_row)
    return map_.select(edges=~goes), int(goes.sum())


def touches(map_: Map, mission_row: int) -> BoolArray:
    """Return for each edge whether one of its vertices lies in a mission."""
    mission = np.append(map_.vertices.mission, -1)  # the last is that of no vertex
    is_touched: BoolArray = (mission[map_.edges.vertex_a] == mission_row) | (
        mission[map_.edges.vertex_b] == mission_row
    )
    return is_touched
