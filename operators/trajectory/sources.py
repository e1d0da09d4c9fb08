"""What links two poses: odometry, wheels, a motion model, under one face.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, sections III-C and IV-D.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from mapstream.operators.odometry.continuous import ContinuousSource, Motion
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import WheelOdometry

EdgeKind = Literal["odometry", "wheel", "motion_model"]
AXES = ("roll", "pitch", "yaw", "x", "y", "z")  # in the order of tangent vectors
AxisSigmas = dict[str, float | None]  # by axis, [rad, m]; None: not measured


class PoseSource(Protocol):
    """Answers any interval that its data encloses, and says when that is settled."""

    @property
    def kind(self) -> EdgeKind: ...
    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The oldest and the newest stamp that it can answer."""
        ...

    def measures(self, start_ns: int, end_ns: int) -> bool:
        """Return whether measurements without a gap enclose the interval."""
        ...

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether `between` answers, by a short prediction at the end of the interval if need be."""
        ...

    def is_decided(self, stamp_ns: int, known_ns: int) -> bool:
        """Return whether nothing can still change the answer up to a stamp, all up to `known_ns` being there."""
        ...

    def newest_before(self, stamp_ns: int) -> int | None:
        """Return the stamp of the newest measurement up to a stamp, None if there is none."""
        ...

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """Return the motion over an interval, predicted a little at its end if need be.

        Raises:
            EstimationError: If the interval is not covered: unavailable.
        """
        ...

    def state_at(self, stamp_ns: int) -> Odometry:
        """Return the pose in the source's own frame, with velocity and biases where it knows them.

        Raises:
            EstimationError: If the stamp is not covered.
        """
        ...


class OdometrySource(ContinuousSource):
    """Odometry of any sensor, for instance visual odometry at 30 Hz (OmniMapper, section IV-D2)."""

    kind: EdgeKind = "odometry"


class WheelSource(ContinuousSource):
    """Wheel odometry: each axis with a noise of its own, or left out where wheels cannot tell.

    Variances grow with the way, so that it does not matter how the way is cut into intervals.
    The covariance of a `WheelOdometry` message is of the pose since the start, and says nothing of a step.
    """

    kind: EdgeKind = "wheel"

    def __init__(
        self,
        sigmas: AxisSigmas,
        *,
        turn_m_per_rad: float = 0.5,
        rest_m_per_s: float = 0.01,
        keep_ns: int = 30_000_000_000,
        max_gap_ns: int | None = None,
    ) -> None:
        """Make a source.

        Args:
            sigmas: By axis, after one metre of way; None: infinite, so that the information is exactly zero.
            turn_m_per_rad: The way that a turn on the spot counts for.
            rest_m_per_s: The way that standing still counts for.
            keep_ns: How far back intervals may begin, at least.
            max_gap_ns: Steps that take longer are not interpolated.
        """
        super().__init__(np.eye(6), keep_ns=keep_ns, max_gap_ns=max_gap_ns)
        given = [sigmas[axis] for axis in AXES]
        self._is_left_out = np.array([sigma is None for sigma in given])
        self._variances = np.square([sigma or 0.0 for sigma in given])  # per metre
        self._turn_m_per_rad, self._rest_m_per_s = turn_m_per_rad, rest_m_per_s
        self._newest: WheelOdometry | None = None

    def add_wheels(self, wheels: WheelOdometry) -> None:
        """Take the next message in.

        Raises:
            EstimationError: If it is not newer than the one before.
        """
        way_m = 0.0
        if self._newest is not None:
            step = self._newest.T_odom_base.inverse() @ wheels.T_odom_base
            elapsed_s = (wheels.stamp_ns - self._newest.stamp_ns) / 1e9
            way_m = float(np.linalg.norm(step.t)) + self._turn_m_per_rad * step.angle_rad
            way_m += self._rest_m_per_s * elapsed_s
        covariance = np.diag(self._variances * way_m)
        self.add(
            Odometry(
                stamp_ns=wheels.stamp_ns, T_odom_base=wheels.T_odom_base, covariance=covariance
            )
        )
        self._newest = wheels

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """As `ContinuousSource.between`, with infinite variance on the axes that are left out."""
        motion = super().between(start_ns, end_ns)
        covariance = motion.covariance.copy()
        covariance[self._is_left_out, :] = covariance[:, self._is_left_out] = 0.0
        covariance[self._is_left_out, self._is_left_out] = np.inf
        return Motion(motion.T_start_end, covariance, motion.is_measured)


def covariance_of(sigmas: AxisSigmas, duration_s: float) -> FloatArray:
    """Return the covariance (6, 6) of sigmas per square root of a second; infinite where there is None."""
    given = [sigmas[axis] for axis in AXES]
    variances = [np.inf if sigma is None else sigma**2 * duration_s for sigma in given]
    return np.diag(variances)


def identity_motion(sigmas: AxisSigmas, start_ns: int, end_ns: int) -> Motion:
    """Return the motion of something that most likely stood still."""
    covariance = covariance_of(sigmas, (end_ns - start_ns) / 1e9)
    return Motion(SE3.identity(), covariance, is_measured=False)
