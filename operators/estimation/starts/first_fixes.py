"""Position fixes wait until they say how a mission lies in their frame: one fix alone has no direction."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from mapstream.operators.estimation.gauge import gauge_factors
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.estimation.priors import prior_factors
from mapstream.operators.estimation.problem import graph_of
from mapstream.operators.estimation.starts.inertial_start import first_velocity_prior, headings
from mapstream.operators.estimation.states import initial_values, with_solution
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import EstimationError

_FEWEST_FIXES = 4  # that a mission and a frame must share
_MIN_SPREAD_M = 10.0
_LINKS = ("odometry", "wheel", "registration")  # say how the robot moved, however it headed
_MAX_ITERATIONS = 25
_WIDENINGS = (
    100.0,
    25.0,
    12.0,
    6.0,
)  # of robust losses: at first all fixes count, then the likely ones


@dataclass(slots=True)
class FirstFixes:
    """Which missions and frames have met: (row of the mission, row of the frame)."""

    met: set[tuple[int, int]] = field(default_factory=set)

    def waiting(self, map_: Map, rows: Iterable[int]) -> set[int]:
        """Return those of new edges that must wait."""
        edges = map_.edges
        fixes = [row for row in rows if edges.kind[row] == "position" and edges.vertex_a[row] >= 0]
        return {row for row in fixes if self._group(map_, row) not in self.met} - self._free(
            map_, fixes
        )

    def asleep(self, map_: Map) -> set[int]:
        """Return the missions that an IMU leads along alone, and no fixes yet: there is nothing to solve."""
        return inertial_missions(map_) - {mission for mission, _ in self.met}

    def meet(self, map_: Map) -> list[IntArray]:
        """Return the fixes of each mission and frame that meet now, since there are enough of them."""
        edges = map_.edges
        is_fix = (edges.kind == "position") & (edges.vertex_a >= 0) & (edges.switch > 0)
        groups: dict[tuple[int, int], list[int]] = {}
        for row in np.flatnonzero(is_fix).tolist():
            groups.setdefault(self._group(map_, row), []).append(row)
        meeting = []
        for group, rows in groups.items():
            spread_m = np.linalg.norm(np.ptp(edges.T_a_b[rows, :3, 3], axis=0))
            if group not in self.met and len(rows) >= _FEWEST_FIXES and spread_m >= _MIN_SPREAD_M:
                self.met.add(group)
                meeting.append(np.array(rows, dtype=np.int64))
        return meeting

    def _group(self, map_: Map, row: int) -> tuple[int, int]:
        vertex = map_.edges.vertex_a[row]
        return int(map_.vertices.mission[vertex]), int(map_.edges.frame[row])

    def _free(self, map_: Map, fixes: list[int]) -> set[int]:
        """Return the fixes that need no others: the motion is linked, and the frame is known."""
        known = np.append(map_.frames.is_known, True)
        return {
            row
            for row in fixes
            if known[map_.edges.frame[row]] and _is_linked(map_, self._group(map_, row)[0])
        }


Softening = Callable[[int, Factor, float], Factor]
"""Puts the factor of an edge's row under the robust loss of its kind, so much wider, if it has one."""


def is_linked(map_: Map, fixes: IntArray) -> bool:
    """Return whether more than an IMU says how the mission moved that these fixes are of."""
    return _is_linked(map_, int(map_.vertices.mission[map_.edges.vertex_a[fixes[0]]]))


def inertial_missions(map_: Map) -> set[int]:
    """Return the missions that an IMU leads along alone."""
    inertial = map_.vertices.mission[map_.edges.vertex_a[map_.edges_of("imu")]]
    return {mission for mission in np.unique(inertial).tolist() if not _is_linked(map_, mission)}


def _is_linked(map_: Map, mission: int) -> bool:
    edges = map_.edges
    own = (edges.vertex_a >= 0) & (map_.vertices.mission[edges.vertex_a] == mission)
    return bool((own & np.isin(edges.kind, _LINKS)).any())


def headed(map_: Map, fixes: IntArray, softened: Softening) -> Map:
    """Return the map with the poses of an inertial mission as its first fixes have them.

    Args:
        map_: With attitudes from integrated rates.
        fixes: Rows of edges of kind position, of one mission and one frame.
        softened: Puts factors under robust losses.

    Raises:
        EstimationError: If no heading makes sense of the fixes.
    """
    mission = int(map_.vertices.mission[map_.edges.vertex_a[fixes[0]]])
    wide, *narrower = _WIDENINGS
    best = _Solution(map_, np.inf)
    for start in headings(map_, mission, fixes):
        found = _solved(start, mission, softened, wide)
        is_confirmed = bool(np.isfinite(found.error)) and abs(found.error / best.error - 1) < 0.01
        best = min(best, found, key=lambda solution: solution.error)
        if is_confirmed:  # two headings lead to one solution, and none so far to a better one
            break
    for widening in narrower:
        best = _solved(best.map, mission, softened, widening)
    if not np.isfinite(best.error):
        name = map_.mission_id(mission)
        raise EstimationError(f"mission {name}: no heading makes sense of its position fixes")
    return best.map


@dataclass(frozen=True, slots=True)
class _Solution:
    map: Map
    error: float  # infinite where there is none


def _solved(start: Map, mission: int, softened: Softening, widening: float) -> _Solution:
    """Return the solution of all that measures one mission alone, and is not switched off."""
    vertex, is_on = start.edges.vertex_a, start.edges.switch > 0
    rows = np.flatnonzero(is_on & (vertex >= 0) & (start.vertices.mission[vertex] == mission))
    factors = make_factors(start, rows, NoiseModels())
    first = int(start.vertices_of(mission)[0])
    holds = [f for f in gauge_factors(start, factors) if f.keys()[0] == first]
    holds += [*prior_factors(start, factors).values(), first_velocity_prior(start, first)]
    soft = [softened(row, factor, widening) for row, factor in factors.items()]
    graph = graph_of([*soft, *holds])
    keys = {key for factor in factors.values() for key in factor.keys()}  # noqa: SIM118  # gtsam's
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(_MAX_ITERATIONS)
    try:
        values = initial_values(start, keys)
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    except RuntimeError:
        return _Solution(start, np.inf)
    return _Solution(with_solution(start, solved), float(graph.error(solved)))
