"""Odometry held in the map: its drift is estimated from the frames that are recognised.

The pose's covariance grows along the odometry and shrinks with each fix (an extended Kalman filter on the pose's
tangent). Fixes that contradict it and agree with each other, at a place elsewhere, are believed after a few: the
robot was carried there. Odometry that drifts is thereby as good as a localisation, and as smooth as asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3

_IN_DOUBT = 2  # fixes that contradict the pose and agree with each other
_GATE = 22.46  # chi2 of six numbers, 99.9 %


class DriftConfig(OperatorConfig):
    """What is believed of odometry and of fixes."""

    sigma_m_per_m: PositiveFloat = 0.03
    """Drift of the odometry's position along the way."""
    sigma_rad_per_m: PositiveFloat = 0.005
    """Drift of its direction along the way."""
    sigma_rad_per_rad: PositiveFloat = 0.01
    """Drift of its direction by turning."""
    fix_sigma_rad: PositiveFloat = 0.005
    """Uncertainty that every fix has beyond what it claims, since the map is not exact."""
    fix_sigma_m: PositiveFloat = 0.03
    """The same of the position."""
    num_agreeing: PositiveInt = 3
    """Fixes that agree with each other, for a robot that is lost or was carried elsewhere."""
    agree_m: PositiveFloat = 0.3
    """How far apart these may be, after the odometry between them."""
    agree_rad: PositiveFloat = 0.1
    """The same of their directions."""
    lost_sigma_m: PositiveFloat = 1.0
    """The robot is lost when its position is as uncertain as that."""
    smooth_mps: NonNegativeFloat = 0.0
    """How fast the odometry's frame moves in the map at most, so that poses do not jump; 0: it jumps."""
    smooth_radps: PositiveFloat = 0.1
    """How fast it turns then."""


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A pose in the map, and the odometry's pose at the same moment."""

    stamp_ns: int
    T_map_base: SE3
    covariance: FloatArray  # (6, 6)
    T_odom_base: SE3

    @property
    def T_map_odom(self) -> SE3:
        return self.T_map_base @ self.T_odom_base.inverse()


class Drift:
    """Where the odometry's frame lies in the map, as it drifts; nowhere as long as the robot is lost."""

    def __init__(self, config: DriftConfig) -> None:
        self._config = config
        self._T_map_odom: SE3 | None = None
        self._covariance: FloatArray = np.zeros((6, 6))  # of T_map_base
        self._odometry: SE3 | None = None  # the newest pose
        self._contradicting: list[Fix] = []
        self._shown: SE3 | None = None  # T_map_odom, as smooth as asked for
        self._shown_ns = 0

    @property
    def is_lost(self) -> bool:
        return self._T_map_odom is None or len(self._contradicting) >= _IN_DOUBT

    @property
    def estimate(self) -> SE3 | None:
        """Where the odometry's frame lies in the map, also while that is in doubt; None as long as nobody knows."""
        return self._T_map_odom

    @property
    def covariance(self) -> FloatArray:
        """Of `T_map_base`, (6, 6)."""
        return self._covariance

    def move(self, T_odom_base: SE3) -> None:
        """Follow the odometry; what is not known of the pose grows."""
        if self._odometry is not None:
            step = self._odometry.inverse() @ T_odom_base
            carry = step.inverse().adjoint()
            metres, turned = float(np.linalg.norm(step.t)), step.angle_rad
            config = self._config
            # variances add along the way, and the drift of a metre does not come all at once
            of_rotation = config.sigma_rad_per_m**2 * metres + config.sigma_rad_per_rad**2 * turned
            of_position = config.sigma_m_per_m**2 * metres
            grown = carry @ self._covariance @ carry.T
            self._covariance = grown + np.diag([of_rotation] * 3 + [of_position] * 3)
        self._odometry = T_odom_base
        if np.sqrt(np.trace(self._covariance[3:, 3:]) / 3) > self._config.lost_sigma_m:
            self._T_map_odom = None
            self._covariance = np.zeros((6, 6))

    def correct(self, fix: Fix) -> None:
        """Take in a fix, or keep it in mind if it contradicts what is known."""
        if self._T_map_odom is not None and self._update(fix, self._T_map_odom):
            self._contradicting.clear()
            return
        self._contradicting = [*(f for f in self._contradicting if self._agree(f, fix)), fix]
        if len(self._contradicting) < self._config.num_agreeing:
            return
        self._T_map_odom, self._covariance = fix.T_map_odom, self._claimed(fix)
        for earlier in self._contradicting[:-1]:
            self._update(earlier, self._T_map_odom)
        self._contradicting.clear()
        self._shown = None

    def T_map_odom(self, stamp_ns: int) -> SE3 | None:
        """Return where the odometry's frame lies in the map at a moment; None while the robot is lost."""
        target = None if self.is_lost else self._T_map_odom
        since_s = (stamp_ns - self._shown_ns) / 1e9
        self._shown_ns = stamp_ns
        if target is None or self._shown is None or not self._config.smooth_mps:
            self._shown = target
        else:
            self._shown = self._towards(target, self._shown, max(since_s, 0.0))
        return self._shown

    def _towards(self, target: SE3, shown: SE3, seconds: float) -> SE3:
        """Return the pose a little nearer to the target, as seen where the robot is."""
        odometry = self._odometry or SE3.identity()
        T_from, T_to = shown @ odometry, target @ odometry
        off = T_from.inverse() @ T_to
        allowed = (
            self._config.smooth_mps * seconds / max(float(np.linalg.norm(off.t)), 1e-12),
            self._config.smooth_radps * seconds / max(off.angle_rad, 1e-12),
            1.0,
        )
        return T_from.interpolate(T_to, min(allowed)) @ odometry.inverse()

    def _claimed(self, fix: Fix) -> FloatArray:
        sigmas = [self._config.fix_sigma_rad] * 3 + [self._config.fix_sigma_m] * 3
        claimed: FloatArray = fix.covariance + np.diag(np.square(sigmas))
        return claimed

    def _update(self, fix: Fix, T_map_odom: SE3) -> bool:
        """Weigh a fix against what is known; whether it is plausible at all."""
        predicted = T_map_odom @ fix.T_odom_base
        off = (predicted.inverse() @ fix.T_map_base).log()
        covariance = self._covariance + self._claimed(fix)
        if off @ np.linalg.solve(covariance, off) > _GATE:
            return False
        gain = self._covariance @ np.linalg.inv(covariance)
        self._T_map_odom = predicted @ SE3.exp(gain @ off) @ fix.T_odom_base.inverse()
        updated = (np.eye(6) - gain) @ self._covariance
        self._covariance = (updated + updated.T) / 2
        return True

    def _agree(self, a: Fix, b: Fix) -> bool:
        off = (a.T_map_odom @ b.T_odom_base).inverse() @ b.T_map_base
        is_near = float(np.linalg.norm(off.t)) <= self._config.agree_m
        return is_near and off.angle_rad <= self._config.agree_rad
