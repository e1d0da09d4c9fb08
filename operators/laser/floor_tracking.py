"""Where a planar laser is on a known floor: found anywhere, followed, and found again.

While the robot is tracked, each scan is matched near where the odometry leads. While it is lost, the last scans,
put together by the odometry, are searched for on the whole floor by branch and bound (Hess et al., Real-time loop
closure in 2D LIDAR SLAM, ICRA 2016), and searches that agree are believed: several views of a way tell rooms apart
that look alike. Between scans the odometry leads, and its drift is estimated.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.laser.floor import Floor
from mapstream.operators.laser.matching import MatchConfig, ScanMatch, match
from mapstream.operators.laser.planar import (
    difference,
    flattened,
    lifted,
    lifted_covariance,
)
from mapstream.operators.laser.recent_scans import RecentScans
from mapstream.operators.laser.surfaces import Surface
from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.drift import Drift, DriftConfig, Fix
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose

_NEAR = MatchConfig(search_distance_m=0.4, final_distance_m=0.15, max_iterations=20)
_FOUND = MatchConfig(search_distance_m=0.6)
_WEAK = np.diag([1e-2, 1e-4, 1e-4])  # information [1/rad^2, 1/m^2] where the scan says nothing
_CELL_M = 0.05
_GROUND = (0.01, 0.02)  # what a planar laser does not see: tilt [rad] and height [m]
_Pose = tuple[float, float, float]


class FloorConfig(OperatorConfig):
    """When the robot counts as found."""

    start: _Pose | None = None
    """x, y [m] and direction [rad] in the map; it is looked for there before it is anywhere."""
    min_fit: float = Field(default=0.65, gt=0.0, le=1.0)
    """Share of a scan's points that lie on what the map shows, while the robot is followed."""
    min_found_fit: float = Field(default=0.8, gt=0.0, le=1.0)
    """The same where it was searched for."""
    min_score: float = Field(default=0.5, ge=0.0, le=1.0)
    """Mean likelihood of the last scans together, where they were searched for; one is a perfect fit."""
    max_misfits: PositiveInt = 10
    """After so many scans in a row that do not fit the robot is lost."""
    search_period_s: PositiveFloat = 1.0
    """Between two searches on the whole floor."""
    gather_m: PositiveFloat = 0.3
    """Way between two of the scans that are searched for together."""
    gather_rad: PositiveFloat = 0.3
    """The same of the turn."""
    gather_scans: PositiveInt = 8
    """At most."""
    least_way_m: NonNegativeFloat = 1.0
    """Way of these scans before they are searched for, for places look alike from one point."""
    drift: DriftConfig = Field(
        default_factory=lambda: DriftConfig(
            sigma_m_per_m=0.1,  # wheels slip
            sigma_rad_per_m=0.02,
            sigma_rad_per_rad=0.05,
            fix_sigma_m=0.02,
            fix_sigma_rad=0.003,
            num_agreeing=2,
            agree_m=0.5,
        )
    )


class FloorTracker:
    """Answers each scan with where the robot is."""

    def __init__(self, floor: Floor, config: FloorConfig) -> None:
        self._floor, self._config = floor, config
        self._drift = Drift(config.drift)
        self._recent = RecentScans(config.gather_scans, _CELL_M)
        self._way_m = 0.0  # of the recent scans
        self._num_misfits = config.max_misfits  # lost at first
        self._searched_ns: int | None = None
        self._T_start_odom: SE3 | None = None  # carries the odometry to where it may have started
        self._has_tracked = self._was_tracking = False

    @property
    def has_tracked(self) -> bool:
        return self._has_tracked

    def track(self, stamp_ns: int, surface: Surface, T_odom_base: SE3) -> MapPose:
        """Return where the robot is, by a scan and the odometry at its stamp.

        Args:
            stamp_ns: Later than before.
            surface: What the scan saw, in the base frame at the stamp.
            T_odom_base: The odometry.
        """
        self._drift.move(T_odom_base)
        fit, verdict = 0, "nothing fits"
        found = self._followed(surface, T_odom_base)
        if found is None and self._num_misfits >= self._config.max_misfits:
            found = self._searched(stamp_ns, surface, T_odom_base)
        if found is not None:
            fit, verdict = round(found.inlier_fraction * len(surface)), "accepted"
            covariance: FloatArray = np.asarray(np.linalg.inv(found.information + _WEAK))
            pose = lifted(found.pose)
            fixed = lifted_covariance(covariance, *_GROUND)
            self._drift.correct(Fix(stamp_ns, pose, fixed, T_odom_base))
            if self._is_there(found.pose, T_odom_base):
                self._num_misfits = 0
        return self._answer(stamp_ns, T_odom_base, fit, verdict)

    def _followed(self, surface: Surface, T_odom_base: SE3) -> ScanMatch | None:
        """Return the match near where the robot is expected; None if there is none."""
        config = self._config
        T_map_odom = self._drift.estimate
        if T_map_odom is None and config.start is not None:
            if self._T_start_odom is None:
                self._T_start_odom = lifted(np.array(config.start)) @ T_odom_base.inverse()
            T_map_odom = self._T_start_odom
        found = None
        if T_map_odom is not None:
            guess = flattened(T_map_odom @ T_odom_base)
            found = self._matched(surface, guess, _NEAR, config.min_fit)
        self._num_misfits += found is None
        if self._num_misfits == 1:
            self._recent.clear()
        return found

    def _is_there(self, pose: FloatArray, T_odom_base: SE3) -> bool:
        """Return whether a pose (3,) is where the robot is believed to be now."""
        T_map_odom = self._drift.estimate
        if T_map_odom is None:
            return False
        off = difference(flattened(T_map_odom @ T_odom_base), pose)
        return bool(np.hypot(off[1], off[2]) < _NEAR.search_distance_m)

    def _searched(self, stamp_ns: int, surface: Surface, T_odom_base: SE3) -> ScanMatch | None:
        """Gather scans, and search for them from time to time; return the match of the newest."""
        config = self._config
        here = flattened(T_odom_base)
        self._gather(surface, here)
        gathered = self._recent.target
        since_ns = config.search_period_s * 1e9
        is_due = self._searched_ns is None or stamp_ns - self._searched_ns >= since_ns
        if gathered is None or self._way_m < config.least_way_m or not is_due:
            return None
        self._searched_ns = stamp_ns
        around = gathered.surface.moved(flattened(T_odom_base.inverse()))
        basin = self._floor.search(around.points, config.min_score)
        if basin.score < config.min_score:
            return None
        return self._matched(surface, basin.pose, _FOUND, config.min_found_fit)

    def _gather(self, surface: Surface, here: FloatArray) -> None:
        """Keep a scan if the robot has moved since the last that was kept."""
        if self._recent.target is None:
            self._way_m = 0.0
        else:
            away = self._recent.away(here)
            step_m = float(np.hypot(away[1], away[2]))
            if step_m < self._config.gather_m and abs(away[0]) < self._config.gather_rad:
                return
            self._way_m += step_m
        if len(surface.lined()):
            self._recent.add(surface, here)

    def _matched(
        self, surface: Surface, guess: FloatArray, config: MatchConfig, min_fit: float
    ) -> ScanMatch | None:
        try:
            found = match(surface, self._floor.target, guess, config)
        except EstimationError:  # too few points: nothing was seen
            return None
        is_near = np.hypot(*difference(guess, found.pose)[1:]) < config.search_distance_m
        return found if is_near and found.inlier_fraction >= min_fit else None

    def _answer(self, stamp_ns: int, T_odom_base: SE3, num_fitting: int, verdict: str) -> MapPose:
        T_map_odom = self._drift.T_map_odom(stamp_ns)
        if self._num_misfits >= self._config.max_misfits:
            T_map_odom = None
        is_back = T_map_odom is not None and self._has_tracked and not self._was_tracking
        self._was_tracking = T_map_odom is not None
        self._has_tracked |= self._was_tracking
        if T_map_odom is None:
            return MapPose(
                stamp_ns=stamp_ns, state="lost", num_inliers=num_fitting, verdict=verdict
            )
        return MapPose(
            stamp_ns=stamp_ns,
            state="recovered" if is_back else "tracking",
            T_map_base=T_map_odom @ T_odom_base,
            T_map_odom=T_map_odom,
            covariance=self._drift.covariance,
            num_inliers=num_fitting,
            verdict=verdict,
        )
