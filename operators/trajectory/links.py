"""The edges between two consecutive poses: one of every source of motion, or a bridge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.odometry.continuous import Motion
from mapstream.operators.odometry.uncertainty import bridged, open_directions
from mapstream.operators.trajectory.imu_source import ImuSource
from mapstream.operators.trajectory.motion_models import MotionModel
from mapstream.operators.trajectory.sources import PoseSource
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.join import END
from mapstream.streams.messages.estimates import RelativePose

_BRIDGE = "bridge"
_TAKEN = 0.5  # of a direction that another source does not see; the rest it measures
_SAMPLES_SAY_IT = np.diag(np.full(6, np.inf))  # an edge of kind imu measures no transform


@dataclass(frozen=True, slots=True)
class Links:
    """All sources of motion of one mission, asked together.

    Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C.
    """

    mission_id: str  # 32 hex digits
    sources: Mapping[
        str, PoseSource
    ]  # by name; the first that measured an interval gives the first guess
    imu: ImuSource | None = None  # its samples become edges beside those of the sources
    bridge: MotionModel | None = None  # links what no source links; None: that is an error

    def is_decided(self, stamp_ns: int, known_ns: int) -> bool:
        """Return whether the edges up to a stamp are settled, all data up to `known_ns` being there."""
        if not all(each.is_decided(stamp_ns, known_ns) for each in self._moving()):
            return False
        # Without a bridge it takes data behind the stamp to tell a gap from the end.
        spans = self.spans()
        goes_on = not spans or any(stamp_ns <= last for _, last in spans)
        return self.bridge is not None or known_ns >= END or goes_on

    def spans(self) -> list[tuple[int, int]]:
        """Return what stretches of time the sources know."""
        return [each.span_ns for each in self._moving() if each.span_ns is not None]

    def is_outside(self, stamp_ns: int) -> bool:
        """Return whether a stamp lies before or after all that is known of motion, and no bridge leads there."""
        spans = self.spans()
        is_before = all(stamp_ns < first for first, _ in spans)
        is_after = all(stamp_ns > last for _, last in spans)
        return self.bridge is None and bool(spans) and (is_before or is_after)

    def motions(self, start_ns: int, end_ns: int) -> list[tuple[str, str, Motion | None]]:
        """Return name, kind and motion of each source that measured the interval; an IMU's motion is None.

        Raises:
            EstimationError: If there is none, and no bridge; it names the pair of poses.
        """
        found: list[tuple[str, str, Motion | None]] = []
        for name, source in self.sources.items():
            if source.measures(start_ns, end_ns):
                motion = source.between(start_ns, end_ns)
                kind = source.kind if motion.is_measured else "motion_model"
                found.append((name, kind, motion))
        if self.imu is not None and self.imu.measures(start_ns, end_ns):
            found.append(("imu", "imu", None))
        if not found and self.bridge is not None:
            found.append((_BRIDGE, "motion_model", self.bridge.between(start_ns, end_ns)))
        if not found:
            known = ", ".join(self.sources) or "none"
            raise EstimationError(
                f"the trajectory falls apart between the poses at {start_ns} and {end_ns} ns: no source"
                f" of motion (there is: {known}) measured all of the interval; add one, or a `bridge`"
            )
        return found

    def edges(self, start_ns: int, end_ns: int) -> tuple[list[RelativePose], Motion | None]:
        """Return the edges of an interval, and the motion that gives the first guess (None: the IMU's).

        Raises:
            EstimationError: As `motions`.
        """
        motions = self.motions(start_ns, end_ns)
        edges = [
            self._edge(
                name, kind, _with_bridge(motion, motions, end_ns - start_ns), start_ns, end_ns
            )
            for name, kind, motion in motions
        ]
        return edges, next((motion for *_, motion in motions if motion is not None), None)

    def _edge(
        self, name: str, kind: str, motion: Motion | None, start_ns: int, end_ns: int
    ) -> RelativePose:
        return RelativePose(
            kind=kind,  # type: ignore[arg-type]  # of EdgeKind, or imu
            mission_a=self.mission_id,
            stamp_a_ns=start_ns,
            mission_b=self.mission_id,
            stamp_b_ns=end_ns,
            T_a_b=SE3.identity() if motion is None else motion.T_start_end,
            covariance=_SAMPLES_SAY_IT if motion is None else motion.covariance,
            source=name,
        )

    def _moving(self) -> list[PoseSource | ImuSource]:
        return [*self.sources.values(), *([self.imu] if self.imu is not None else [])]


def _with_bridge(
    motion: Motion | None, motions: Sequence[tuple[str, str, Motion | None]], duration_ns: int
) -> Motion | None:
    """Return a motion whose open directions are left to the other sources, or bridged where none takes them.

    Those of infinite variance are open on purpose, and stay so.
    """
    if motion is None or not np.isfinite(np.diagonal(motion.covariance)).all():
        return motion
    left = open_directions(motion.covariance)
    for _, _, other in motions:
        if other is None:
            return motion
        if other is not motion and len(left):
            unseen = np.linalg.norm(open_directions(other.covariance) @ left.T, axis=0)
            left = left[unseen > _TAKEN]
    if not len(left):
        return motion
    return replace(motion, covariance=bridged(motion.covariance, duration_ns / 1e9))
