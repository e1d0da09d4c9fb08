"""Finding a robot anywhere on a known floor, and believing it only when nowhere else will do.

The last scans, put together by the odometry, are searched for on the whole floor by branch and bound (Hess et al.,
Real-time loop closure in 2D LIDAR SLAM, ICRA 2016). Each place that scores nearly as well as the best is a
hypothesis: the robot is followed from it back along its way, scan by scan. What speaks for it are points on walls,
what speaks against it are beams that would have passed through walls (the likelihood field and the beam model of
Thrun, Burgard, Fox: Probabilistic Robotics, 2005, chapter 6). Corridors and rooms look alike: the best is believed
only if it leads the others, else more of the way is waited for.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.laser.floor import Floor
from mapstream.operators.laser.matching import MatchConfig, ScanMatch, match
from mapstream.operators.laser.planar import apply, difference, flattened, lifted
from mapstream.operators.laser.recent_scans import first_in_cells
from mapstream.operators.laser.surfaces import Surface
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

NEAR = MatchConfig(search_distance_m=0.4, final_distance_m=0.15, max_iterations=20)
_CELL_M = 0.05
_RIVAL_SCORE = 0.1  # below the best, of places that are looked at closely
_MAX_RIVALS = 6


class FloorSearchConfig(OperatorConfig):
    """When a place that was searched for is believed."""

    min_found_fit: float = Field(default=0.8, gt=0.0, le=1.0)
    """Share of a scan's points that lie on what the map shows, where it was searched for."""
    min_score: float = Field(default=0.5, ge=0.0, le=1.0)
    """Mean likelihood of the last scans together, where they were searched for; one is a perfect fit."""
    min_lead: float = Field(default=0.05, ge=0.0, le=1.0)
    """By which the best place's share of fitting points, less that of beams through walls, exceeds all others'."""
    search_period_s: PositiveFloat = 1.0
    """Between two searches on the whole floor."""
    gather_m: PositiveFloat = 0.3
    """Way between two of the scans that are searched for together."""
    gather_rad: PositiveFloat = 0.3
    """The same of the turn."""
    gather_scans: PositiveInt = 12
    """At most."""
    least_way_m: NonNegativeFloat = 1.0
    """Way of these scans before they are searched for, for places look alike from one point."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one scan saw."""

    surface: Surface  # in the base frame
    eye: FloatArray  # (2,) where the laser was, in the base frame
    odometry: FloatArray  # (3,) pose of the base


def placed(view: View, floor: Floor, guess: FloatArray) -> tuple[ScanMatch, float] | None:
    """Return where a scan fits near a guess (3,), and the share of its beams that would pass through walls there.

    None if it fits nowhere near.
    """
    try:
        found = match(view.surface, floor.target, guess, NEAR)
    except EstimationError:  # too few points: nothing was seen
        return None
    if np.hypot(*difference(guess, found.pose)[1:]) > NEAR.search_distance_m:
        return None
    eye = apply(found.pose, view.eye[None])[0]
    crossed = floor.walls.crossed(apply(found.pose, view.surface.points), eye)
    return found, float(crossed.mean())


class FloorSearch:
    """Gathers scans along the way, and searches for them from time to time."""

    def __init__(self, floor: Floor, config: FloorSearchConfig) -> None:
        self._floor, self._config = floor, config
        self._views: deque[View] = deque(maxlen=config.gather_scans)  # the newest first
        self._way_m = 0.0
        self._searched_ns: int | None = None

    def clear(self) -> None:
        """Forget the way."""
        self._views.clear()
        self._way_m = 0.0

    def find(self, stamp_ns: int, view: View) -> ScanMatch | None:
        """Return where the newest scan fits, if that is the only place where the scans before it fit, too."""
        self._gather(view)
        since_ns = self._config.search_period_s * 1e9
        is_due = self._searched_ns is None or stamp_ns - self._searched_ns >= since_ns
        if not self._views or self._way_m < self._config.least_way_m or not is_due:
            return None
        self._searched_ns = stamp_ns
        found: list[tuple[float, ScanMatch]] = []
        basins = self._floor.basins(self._around(view), self._config.min_score, _RIVAL_SCORE)
        for _, basin in zip(range(_MAX_RIVALS), basins, strict=False):
            judged = self._judged(view, basin.pose)
            if judged is not None:
                found.append(judged)
        found.sort(key=lambda judged: -judged[0])
        if not found:
            return None
        evidence, best = found[0]
        rivals = [
            rival
            for rival, other in found[1:]
            if np.hypot(*(other.pose - best.pose)[:2]) > NEAR.search_distance_m
        ]
        is_clear = all(evidence - rival >= self._config.min_lead for rival in rivals)
        return best if is_clear and best.inlier_fraction >= self._config.min_found_fit else None

    def _gather(self, view: View) -> None:
        """Keep a scan if the robot has moved since the last that was kept."""
        if self._views:
            away = difference(self._views[0].odometry, view.odometry)
            step_m = float(np.hypot(away[1], away[2]))
            if step_m < self._config.gather_m and abs(away[0]) < self._config.gather_rad:
                return
            self._way_m += step_m
        if len(view.surface.lined()):
            self._views.appendleft(view)

    def _around(self, view: View) -> FloatArray:
        """Return what the scans that were kept saw (N, 2), in the frame of the newest scan."""
        T_base_odom = lifted(view.odometry).inverse()
        points = [
            kept.surface.lined().moved(flattened(T_base_odom @ lifted(kept.odometry))).points
            for kept in self._views
        ]
        together = np.concatenate(points)
        return together[first_in_cells(together, _CELL_M)]

    def _judged(self, view: View, pose: FloatArray) -> tuple[float, ScanMatch] | None:
        """Return what speaks for a pose (3,) of the newest scan, and its match; None if it does not fit."""
        first = placed(view, self._floor, pose)
        if first is None:
            return None
        newest, crossed = first
        evidence = [newest.inlier_fraction - crossed]
        T_map_odom = lifted(newest.pose) @ lifted(view.odometry).inverse()
        for kept in self._views:
            at = placed(kept, self._floor, flattened(T_map_odom @ lifted(kept.odometry)))
            if at is None:
                evidence.append(0.0)
                continue
            evidence.append(at[0].inlier_fraction - at[1])
            T_map_odom = lifted(at[0].pose) @ lifted(kept.odometry).inverse()
        return float(np.mean(evidence)), newest
