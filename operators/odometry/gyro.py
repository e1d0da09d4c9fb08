"""The gyroscope's samples around each scan, joined by time."""

from __future__ import annotations

from mapstream.operators.lidar.deskew import gyro_trajectory
from mapstream.operators.operator import warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.trajectory import Trajectory


class GyroWindow:
    """Reads IMU batches as far as they are needed, and forgets them when they are not."""

    def __init__(self, imu: Receiver[ImuBatch] | None) -> None:
        self._imu = imu
        self._batches: list[ImuBatch] = []

    async def until(self, end_ns: int) -> list[ImuBatch]:
        """Wait until the samples reach `end_ns`, or the stream ends; return all that are kept."""
        while self._imu is not None and not (
            self._batches and self._batches[-1].stamp_ns >= end_ns
        ):
            batch = await anext(self._imu, None)
            if batch is None:
                break
            self._batches.append(batch)
        return list(self._batches)

    def forget(self, before_ns: int) -> None:
        """Drop what is not needed from a time on; the last sample before it is, as motion begins there."""
        num_before = sum(batch.stamp_ns <= before_ns for batch in self._batches)
        self._batches = self._batches[max(0, num_before - 1) :]


def turning(
    batches: list[ImuBatch], start_ns: int, end_ns: int, velocity_mps: FloatArray
) -> Trajectory | None:
    """Return the motion of the base from gyroscope and velocity, or None without samples for the interval.

    Args:
        batches: In order of time.
        start_ns: The motion must be known from here.
        end_ns: And to here.
        velocity_mps: (3,) in the base frame at the first sample.
    """
    if not batches:
        return None
    if batches[0].stamps_ns[0] > start_ns or batches[-1].stamp_ns < end_ns:
        warn("the IMU does not cover a scan; its motion is taken as constant")
        return None
    return gyro_trajectory(batches, velocity_mps)
