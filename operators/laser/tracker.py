"""Where a planar laser is, scan after scan, by matching each to what the last ones saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.laser.beams import BeamEnds, beam_ends
from mapstream.operators.laser.correlative import LikelihoodGrid, Window
from mapstream.operators.laser.matching import MatchConfig, Prior, ScanMatch, covariance_of, match
from mapstream.operators.laser.planar import difference, flattened, perturbed
from mapstream.operators.laser.recent_scans import RecentScans
from mapstream.operators.laser.surfaces import Surface, surface_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory

_BEND_LIMIT_M = 0.01  # about the noise of a range
_REST_M_PER_S = 0.01  # the way that standing still counts for
_LEAST_PART = 0.02  # of a match's uncertainty, for a scan that went into nothing
_NEAR = MatchConfig(search_distance_m=0.3)
_FAR = Window(radius_m=0.6, turn_rad=float(np.radians(25)))


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """What to believe, and what to keep."""

    num_keyframes: int
    keyframe_m: float
    keyframe_rad: float
    cell_m: float
    max_range_m: float
    min_inlier_fraction: float
    max_lost_scans: int
    wheels: FloatArray  # (3,) deviation of yaw, x, y after a metre of way
    turn_m_per_rad: float  # the way that a turn on the spot counts for
    accelerations: FloatArray  # (3,) of yaw, x, y: so much, where there are no wheels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracked:
    """One scan's outcome."""

    pose: FloatArray  # (3,) of the base in the odom frame
    velocity: FloatArray  # (3,) tangent per second
    covariance: FloatArray  # (3, 3) of the step since the scan before
    points: FloatArray  # (N, 3) in the base frame at the scan's end [m]
    problem: str = ""  # why the scan's own match was not believed, if it was not
    has_wheels: bool = False  # the step is the wheels' where the match was not believed


class Tracker:
    """Matches scans to the last keyframes; motion is predicted by wheels, or by constant velocity.

    The prediction is weighed with the match, so that it leads along a corridor that shows nothing.
    A match is as uncertain as its keyframe: steps between keyframes share that uncertainty by their way, since all of
    them are compared with the same surfaces.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._recent = RecentScans(config.num_keyframes, config.cell_m)
        self._pose: FloatArray = np.zeros(3)
        self._velocity: FloatArray = np.zeros(3)
        self._last_ns: int | None = None
        self._T_wheels: SE3 | None = None  # by the wheels, at the last scan
        self._num_lost = 0

    def track(self, scan: LaserScan2D, T_wheels: SE3 | None) -> Tracked:
        """Find the pose of the base at the end of a scan, which is later than that of the one before.

        Args:
            scan: The scan.
            T_wheels: T_odom_base at its end by wheels or another odometry; None where they say nothing.
        """
        step_s = 0.0 if self._last_ns is None else (scan.end_ns - self._last_ns) / 1e9
        step, prior_covariance = self._predicted(T_wheels, step_s)
        has_wheels = T_wheels is not None and self._T_wheels is not None
        predicted = perturbed(self._pose, step)
        prior = Prior(predicted, np.diag(1 / np.diagonal(prior_covariance)))
        velocity = step / step_s if step_s > 0 else self._velocity
        seen = self._seen(scan, velocity)
        surface = surface_of(seen.points[:, :2], scan.T_base_sensor.t[:2])
        found, problem = self._match(surface, prior)
        if found is not None and step_s > 0:
            measured = difference(self._pose, found.pose) / step_s
            if _bend_m(scan, seen, measured - velocity) > _BEND_LIMIT_M:
                seen = self._seen(scan, measured)
                surface = surface_of(seen.points[:, :2], scan.T_base_sensor.t[:2])
                found, problem = self._match(surface, prior)
        pose = predicted if found is None else found.pose
        covariance = prior_covariance if found is None else self._covariance(found, prior)
        moved = difference(self._pose, pose)
        if step_s > 0 and (found is not None or has_wheels):
            self._velocity = moved / step_s
        self._pose, self._last_ns, self._T_wheels = pose, scan.end_ns, T_wheels
        self._keep(surface, is_lost=found is None)
        return Tracked(
            pose=pose,
            velocity=self._velocity,
            covariance=covariance,
            points=seen.points,
            problem=problem,
            has_wheels=has_wheels,
        )

    def _predicted(self, T_wheels: SE3 | None, step_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the step (3,) since the last scan as it is expected, and its covariance (3, 3)."""
        config = self._config
        if T_wheels is not None and self._T_wheels is not None:
            step = difference(np.zeros(3), flattened(self._T_wheels.inverse() @ T_wheels))
            way_m = float(np.hypot(step[1], step[2])) + config.turn_m_per_rad * abs(step[0])
            way_m += _REST_M_PER_S * max(step_s, 0.1)
            return step, np.diag(config.wheels**2) * way_m
        duration_s = max(step_s, 0.1)
        return self._velocity * step_s, np.diag((config.accelerations * duration_s**2 + 0.01) ** 2)

    def _seen(self, scan: LaserScan2D, velocity: FloatArray) -> BeamEnds:
        """Return what the scan hit, carried to its end by a velocity (3,)."""
        way = None
        if scan.end_ns > scan.stamp_ns:
            back = np.zeros((2, 6))
            back[0, 2:5] = -velocity * ((scan.end_ns - scan.stamp_ns) / 1e9)
            stamps_ns = np.array([scan.stamp_ns, scan.end_ns])
            way = Trajectory(stamps_ns=stamps_ns, poses=se3_exp(back))
        ends = beam_ends(scan, way)
        keep = ends.ranges_m <= self._config.max_range_m
        return BeamEnds(ends.stamp_ns, ends.points[keep], ends.beams[keep], ends.ranges_m[keep])

    def _match(self, surface: Surface, prior: Prior) -> tuple[ScanMatch | None, str]:
        """Match near the prediction, then farther around it; return None and the reason if neither is believed."""
        target = self._recent.target
        if target is None:
            return None, "" if len(surface.lined()) else "it shows no line"
        try:
            found = match(surface, target, prior.pose, _NEAR, prior)
            if not self._is_believed(found):
                grid = LikelihoodGrid(target.surface.points)
                basin = grid.search(surface.points, prior.pose, _FAR)
                found = match(surface, target, basin.pose, _NEAR)
        except EstimationError as error:
            return None, str(error)
        if self._is_believed(found):
            return found, ""
        return None, f"{100 * found.inlier_fraction:.0f} % of it fit"

    def _is_believed(self, found: ScanMatch) -> bool:
        return found.inlier_fraction >= self._config.min_inlier_fraction

    def _covariance(self, found: ScanMatch, prior: Prior) -> FloatArray:
        """Return that of the step: a keyframe's match is spent along the way to it."""
        config = self._config
        step = difference(self._pose, found.pose)
        part = np.hypot(step[1], step[2]) / config.keyframe_m + abs(step[0]) / config.keyframe_rad
        part = min(max(float(part), _LEAST_PART), 1.0)
        return covariance_of(found.information / part + prior.information)

    def _keep(self, surface: Surface, *, is_lost: bool) -> None:
        """Make the scan a keyframe if it is the first, far from the last one, or ends a time of being lost."""
        self._num_lost = self._num_lost + 1 if is_lost and self._recent.target else 0
        if self._num_lost > self._config.max_lost_scans:
            self._recent.clear()
            self._num_lost = 0
        is_first = self._recent.target is None
        if not len(surface.lined()) or (is_lost and not is_first):
            return
        away = self._recent.away(self._pose)
        is_far = np.hypot(away[1], away[2]) >= self._config.keyframe_m
        if is_first or is_far or abs(away[0]) >= self._config.keyframe_rad:
            self._recent.add(surface, self._pose)


def _bend_m(scan: LaserScan2D, seen: BeamEnds, velocity: FloatArray) -> float:
    """Return the distortion that is left where the sweep was carried by a velocity that is wrong by so much."""
    reach_m = float(np.median(seen.ranges_m)) if len(seen) else 0.0
    speed = float(np.hypot(velocity[1], velocity[2])) + reach_m * abs(float(velocity[0]))
    return speed * (scan.end_ns - scan.stamp_ns) / 1e9
