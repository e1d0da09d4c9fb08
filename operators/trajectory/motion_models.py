"""Motion models: what probably happened where nothing was measured.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV-D3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from mapstream.operators.odometry.continuous import Motion
from mapstream.operators.trajectory.sources import (
    AXES,
    AxisSigmas,
    EdgeKind,
    PoseSource,
    covariance_of,
    identity_motion,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry

WEAK: AxisSigmas = dict.fromkeys(
    AXES, 100.0
)  # per square root of a second, as OmniMapper's null model


class MotionModel(Protocol):
    """Says something of every interval, with little confidence."""

    def between(self, start_ns: int, end_ns: int) -> Motion: ...


class StandingStill:
    """The null motion model: a weak prior that nothing moved.

    It bridges what no sensor measured; or it is a source of its own, always there, that holds the axes
    which the sensors leave out.
    """

    kind: EdgeKind = "motion_model"
    span_ns: tuple[int, int] | None = None

    def __init__(self, sigmas: AxisSigmas | None = None) -> None:
        """Take sigmas by axis, per square root of a second; None leaves an axis out."""
        self._sigmas = WEAK if sigmas is None else sigmas

    def measures(self, start_ns: int, end_ns: int) -> bool:
        return start_ns <= end_ns

    def covers(self, start_ns: int, end_ns: int) -> bool:
        return self.measures(start_ns, end_ns)

    def is_decided(self, stamp_ns: int, known_ns: int) -> bool:  # noqa: ARG002  # it needs no data
        return True

    def newest_before(self, stamp_ns: int) -> int | None:  # noqa: ARG002
        return None

    def between(self, start_ns: int, end_ns: int) -> Motion:
        return identity_motion(self._sigmas, start_ns, end_ns)

    def state_at(self, stamp_ns: int) -> Odometry:
        return Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity())


class ConstantVelocity:
    """The last velocity goes on; where none is known, nothing moves."""

    def __init__(
        self,
        sources: Sequence[PoseSource],
        *,
        sigmas: AxisSigmas | None = None,
        memory_ns: int = 500_000_000,
    ) -> None:
        """Make a model.

        Args:
            sources: Whose velocity goes on; the first that knows one is asked.
            sigmas: By axis, per square root of a second.
            memory_ns: Over how long the velocity is taken.
        """
        self._sources = sources
        self._sigmas = WEAK if sigmas is None else sigmas
        self._memory_ns = memory_ns

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """Return the motion at the velocity before the interval."""
        elapsed_s = (end_ns - start_ns) / 1e9
        T_start_end = SE3.exp(self._twist_before(start_ns) * elapsed_s)
        return Motion(T_start_end, covariance_of(self._sigmas, elapsed_s), is_measured=False)

    def _twist_before(self, stamp_ns: int) -> FloatArray:
        """Return the velocity (6,) [rad/s, m/s] in the base, before a stamp or the gap around it."""
        for source in self._sources:
            newest_ns = source.newest_before(stamp_ns)
            if newest_ns is not None and source.measures(newest_ns - self._memory_ns, newest_ns):
                motion = source.between(newest_ns - self._memory_ns, newest_ns)
                return motion.T_start_end.log() / (self._memory_ns / 1e9)
        return np.zeros(6)
