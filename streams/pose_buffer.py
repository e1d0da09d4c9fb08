"""The newest odometry, answered at any time within it and a little beyond."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

from mapstream.streams.errors import TransformError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BufferedPose:
    """A pose of the base in the odometry's frame."""

    stamp_ns: int
    T_odom_base: SE3
    is_predicted: bool  # beyond the newest measurement


class PoseBuffer:
    """Odometry of the last seconds; beyond the newest it goes on at constant velocity for a while.

    Source: maplab 2.0's odometry buffer, with its limits of 30 s and 500 ms.
    """

    def __init__(
        self, *, length_ns: int = 30 * _SECOND_NS, max_prediction_ns: int = _SECOND_NS // 2
    ) -> None:
        self._length_ns = length_ns
        self._max_prediction_ns = max_prediction_ns
        self._stamps_ns: list[int] = []
        self._poses: list[SE3] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, odometry: Odometry) -> None:
        """Take the next pose and forget those that are too old.

        Raises:
            ValueError: If it is not newer than the last one; `clear` first after a jump in time.
        """
        if self._stamps_ns and odometry.stamp_ns <= self._stamps_ns[-1]:
            raise ValueError(f"odometry at {odometry.stamp_ns} after {self._stamps_ns[-1]} ns")
        self._stamps_ns.append(odometry.stamp_ns)
        self._poses.append(odometry.T_odom_base)
        num_old = bisect_left(self._stamps_ns, odometry.stamp_ns - self._length_ns)
        del self._stamps_ns[:num_old], self._poses[:num_old]

    def clear(self) -> None:
        self._stamps_ns.clear()
        self._poses.clear()

    def pose_at(self, stamp_ns: int) -> BufferedPose:
        """Return the pose at a time, interpolated, or predicted from the last two poses.

        Raises:
            TransformError: If the time lies before the buffer or too far beyond it.
        """
        stamps_ns = self._stamps_ns
        if not stamps_ns or stamp_ns < stamps_ns[0]:
            span = f"{stamps_ns[0]} to {stamps_ns[-1]} ns" if stamps_ns else "nothing"
            raise TransformError(f"no odometry at {stamp_ns} ns: the buffer holds {span}")
        if stamp_ns > stamps_ns[-1]:
            return self._predicted(stamp_ns)
        right = bisect_left(stamps_ns, stamp_ns)
        T_odom_base = self._poses[right]
        if stamps_ns[right] != stamp_ns:
            start_ns, end_ns = stamps_ns[right - 1], stamps_ns[right]
            fraction = (stamp_ns - start_ns) / (end_ns - start_ns)
            T_odom_base = self._poses[right - 1].interpolate(T_odom_base, fraction)
        return BufferedPose(stamp_ns=stamp_ns, T_odom_base=T_odom_base, is_predicted=False)

    def _predicted(self, stamp_ns: int) -> BufferedPose:
        ahead_ns = stamp_ns - self._stamps_ns[-1]
        if ahead_ns > self._max_prediction_ns or len(self) < 2:
            raise TransformError(
                f"no odometry at {stamp_ns} ns: that is {ahead_ns / 1e6:g} ms beyond the newest, and "
                f"at most {self._max_prediction_ns / 1e6:g} ms are predicted from two poses or more"
            )
        T_odom_previous, T_odom_last = self._poses[-2:]
        step = (T_odom_previous.inverse() @ T_odom_last).log()
        step_ns = self._stamps_ns[-1] - self._stamps_ns[-2]
        T_odom_base = T_odom_last @ SE3.exp(step * (ahead_ns / step_ns))
        return BufferedPose(stamp_ns=stamp_ns, T_odom_base=T_odom_base, is_predicted=True)
