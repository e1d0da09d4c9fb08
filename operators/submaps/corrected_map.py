"""A map that grows by submaps and follows the optimizer: what loop search looks for loops in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.operator import warn
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import IntArray
from mapstream.streams.channel import Receiver
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapCorrection, RelativePose, Submap


class CorrectedMap:
    """The submaps so far, at the poses that the optimizer had after the one before; never at newer ones.

    That way a replay finds the same loops.
    """

    def __init__(self) -> None:
        self.map = Map.empty()
        self._newest_ns: dict[str, int] = {}

    async def follow(self, corrections: Receiver[MapCorrection] | None, submap: Submap) -> None:
        """Wait for the poses that the optimizer had before a submap of its mission."""
        before_ns = self._newest_ns.get(submap.mission_id)
        self._newest_ns[submap.mission_id] = submap.stamp_ns
        if corrections is None or before_ns is None:
            return
        async for correction in corrections:
            self._correct(correction)
            if correction.mission_id == submap.mission_id and correction.stamp_ns >= before_ns:
                return
        warn("the optimizer's corrections ended; loops are searched by odometry")

    def append(self, submap: Submap) -> IntArray:
        """Add a submap without its measurements; return its new vertices in the order of time."""
        first = len(self.map.vertices)
        self.map = append_submap(self.map, replace(submap, constraints=()))
        new = np.arange(first, len(self.map.vertices))
        return new[np.argsort(self.map.vertices.stamp_ns[new], kind="stable")]

    def loop(self, edge: Edges) -> RelativePose:
        """Return an edge of kind `loop`, one row, as a message that other maps can take."""
        vertices, a, b = self.map.vertices, int(edge.vertex_a[0]), int(edge.vertex_b[0])
        return RelativePose(
            kind="loop",
            mission_a=self.map.mission_id(int(vertices.mission[a])),
            stamp_a_ns=int(vertices.stamp_ns[a]),
            mission_b=self.map.mission_id(int(vertices.mission[b])),
            stamp_b_ns=int(vertices.stamp_ns[b]),
            T_a_b=SE3(edge.T_a_b[0]),
            covariance=edge.covariance[0],
            source=str(edge.source[0]),
            is_switchable=bool(edge.is_switchable[0]),
        )

    def _correct(self, correction: MapCorrection) -> None:
        rows = self.map.vertices_of(self.map.mission_row(correction.mission_id))
        stamps_ns = self.map.vertices.stamp_ns[rows]
        at = np.searchsorted(correction.stamps_ns, stamps_ns)
        is_known = np.append(correction.stamps_ns, -1)[at] == stamps_ns
        poses = correction.T_mission_base[at[is_known]]
        self.map = with_poses(self.map, rows[is_known], poses)
