"""Where a planar laser is on a known floor: found anywhere, followed, and found again.

While the robot is tracked, each scan is matched near where the odometry leads, and does not fit there if its beams
would pass through walls. While it is lost, it is searched for. Between scans the odometry leads, and its drift is
estimated.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.laser.floor import Floor
from mapstream.operators.laser.floor_search import (
    NEAR,
    FloorSearch,
    FloorSearchConfig,
    View,
    placed,
)
from mapstream.operators.laser.matching import ScanMatch
from mapstream.operators.laser.planar import difference, flattened, lifted, lifted_covariance
from mapstream.operators.laser.surfaces import Surface
from mapstream.operators.places.drift import Drift, DriftConfig, Fix
from mapstream.operators.places.map_poses import MapPoses
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose

_WEAK = np.diag([1e-2, 1e-4, 1e-4])  # information [1/rad^2, 1/m^2] where the scan says nothing
_GROUND = (0.01, 0.02)  # what a planar laser does not see: tilt [rad] and height [m]
_Pose = tuple[float, float, float]


class FloorConfig(FloorSearchConfig):
    """When the robot counts as found."""

    start: _Pose | None = None
    """x, y [m] and direction [rad] in the map; it is looked for there before it is anywhere."""
    min_fit: float = Field(default=0.65, gt=0.0, le=1.0)
    """Share of a scan's points that lie on what the map shows, while the robot is followed."""
    max_crossed: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of a scan's beams that would pass through walls of the map, while the robot is followed."""
    max_misfits: PositiveInt = 10
    """After so many scans in a row that do not fit the robot is lost."""
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
        self._search = FloorSearch(floor, config)
        self._num_misfits = config.max_misfits  # lost at first
        self._T_start_odom: SE3 | None = None  # carries the odometry to where it may have started
        self._poses = MapPoses()

    @property
    def has_tracked(self) -> bool:
        return self._poses.has_tracked

    def track(self, stamp_ns: int, surface: Surface, T_odom_base: SE3, eye: FloatArray) -> MapPose:
        """Return where the robot is, by a scan and the odometry at its stamp.

        Args:
            stamp_ns: Later than before.
            surface: What the scan saw, in the base frame at the stamp.
            T_odom_base: The odometry.
            eye: (2,) where the laser was, in the base frame.
        """
        view = View(surface, eye, flattened(T_odom_base))
        self._drift.move(T_odom_base)
        fit, verdict = 0, "nothing fits"
        found = self._followed(view, T_odom_base)
        if found is None and self._is_lost:
            found = self._search.find(stamp_ns, view)
        if found is not None:
            fit, verdict = round(found.inlier_fraction * len(surface)), "accepted"
            covariance: FloatArray = np.asarray(np.linalg.inv(found.information + _WEAK))
            pose = lifted(found.pose)
            fixed = lifted_covariance(covariance, *_GROUND)
            self._drift.correct(Fix(stamp_ns, pose, fixed, T_odom_base))
            if self._is_there(found.pose, T_odom_base):
                self._num_misfits = 0
        return self._answer(stamp_ns, T_odom_base, fit, verdict)

    def _followed(self, view: View, T_odom_base: SE3) -> ScanMatch | None:
        """Return the match near where the robot is expected; None if there is none, or it is lost."""
        T_map_odom = self._expected(T_odom_base)
        found = None
        if T_map_odom is not None:
            near = placed(view, self._floor, flattened(T_map_odom @ T_odom_base))
            if near is not None and near[1] <= self._config.max_crossed:
                found = near[0] if near[0].inlier_fraction >= self._config.min_fit else None
        self._num_misfits += found is None
        if self._num_misfits == 1:
            self._search.clear()
        return found

    def _expected(self, T_odom_base: SE3) -> SE3 | None:
        """Return where the odometry's frame lies in the map; None while the robot is lost, but for a start that is given."""
        if not self._is_lost:
            return self._drift.estimate
        if self._drift.estimate is None and self._config.start is not None:
            if self._T_start_odom is None:
                self._T_start_odom = lifted(np.array(self._config.start)) @ T_odom_base.inverse()
            return self._T_start_odom
        return None

    @property
    def _is_lost(self) -> bool:
        return self._num_misfits >= self._config.max_misfits

    def _is_there(self, pose: FloatArray, T_odom_base: SE3) -> bool:
        """Return whether a pose (3,) is where the robot is believed to be now."""
        T_map_odom = self._drift.estimate
        if T_map_odom is None:
            return False
        off = difference(flattened(T_map_odom @ T_odom_base), pose)
        return bool(np.hypot(off[1], off[2]) < NEAR.search_distance_m)

    def _answer(self, stamp_ns: int, T_odom_base: SE3, num_fitting: int, verdict: str) -> MapPose:
        T_map_odom = self._drift.T_map_odom(stamp_ns)
        if self._is_lost:
            T_map_odom = None
        moment = stamp_ns, T_odom_base
        return self._poses.next(moment, T_map_odom, self._drift.covariance, num_fitting, verdict)
