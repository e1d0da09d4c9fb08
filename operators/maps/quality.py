"""How well the poses of a map agree with what the robots measured of their own motion.

A loop that is false and believed bends a trajectory: odometry then contradicts the poses far beyond its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.maps.residuals import chi2, num_measured, relative_edges
from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import EstimationError

_MOST = 1.25  # standard deviations: poses that only noise moved stay below 1, whatever their number
_MOST_IF_SWITCHED = (
    2.5  # where false loops could be switched off: noise of real odometry is often understated
)
_GROWTH = 1.5  # times what it was: covariances of some maps are too small to begin with


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """The strain of each mission: the rms of its motion's residuals, in standard deviations."""

    strain: dict[str, float]  # by the id of a mission that has such edges

    @property
    def worst(self) -> float:
        return max(self.strain.values(), default=0.0)


def map_quality(map_: Map) -> Quality:
    """Return how much each mission's own motion contradicts the poses."""
    rows = relative_edges(map_, MOTION_KINDS)
    mission = map_.vertices.mission[map_.edges.vertex_a[rows]]
    squared = np.bincount(mission, chi2(map_, rows), minlength=len(map_.missions))
    counts = np.bincount(mission, num_measured(map_, rows), minlength=len(map_.missions))
    return Quality(
        strain={
            map_.mission_id(row): float(np.sqrt(squared[row] / counts[row]))
            for row in np.flatnonzero(counts).tolist()
        }
    )


def require_no_worse(before: Map, after: Map, *, may_switch: bool = True) -> None:
    """Refuse a solution that bends a mission far beyond the noise of its own motion.

    Args:
        before: The map that was solved.
        after: The solution.
        may_switch: Whether the solver was free to switch false loops off.

    Raises:
        EstimationError: If a mission is strained by more than 1.25 sigma (2.5 where every loop could be
            switched off), and half more than before.
    """
    loops = after.edges.kind == "loop"
    was_free = may_switch and bool(after.edges.is_switchable[loops].all())
    most = _MOST_IF_SWITCHED if was_free else _MOST
    was = map_quality(before).strain
    for mission_id, strain in map_quality(after).strain.items():
        if strain > max(most, _GROWTH * was.get(mission_id, 0.0)):
            raise EstimationError(
                f"the map got worse and stays as it was: mission {mission_id}'s own motion now contradicts"
                f" its poses by {strain:.2f} sigma (rms), {was.get(mission_id, 0.0):.2f} before; let solvers"
                " switch false loops off (edit switch --kind loop --set is_switchable=true), or take the"
                " solution all the same (--keep)"
            )
