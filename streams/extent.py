"""What stretch of time a message tells of: an instant, a sweep, a batch of samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapstream.streams.messages.sensors import ImuBatch, LaserScan2D, LidarScan, Message


class Extent(NamedTuple):
    """First and last instant, both included."""

    start_ns: int
    end_ns: int


def extent_of(message: Message) -> Extent:
    """Return when the content of a message begins and ends."""
    if isinstance(message, ImuBatch):
        return Extent(int(message.stamps_ns[0]), int(message.stamps_ns[-1]))
    if isinstance(message, LaserScan2D):
        return Extent(message.stamp_ns, message.end_ns)
    if (
        isinstance(message, LidarScan)
        and message.offsets_ns is not None
        and message.offsets_ns.size
    ):
        return Extent(message.stamp_ns + int(message.offsets_ns.min()), message.end_ns)
    return Extent(message.stamp_ns, message.stamp_ns)


def cut_imu(batch: ImuBatch, start_ns: int, end_ns: int) -> ImuBatch:
    """Return the samples from start to end, with one neighbour on either side where the batch has it.

    The neighbours let an integrator interpolate at the very ends of the interval.
    """
    first = int(np.searchsorted(batch.stamps_ns, start_ns, side="right")) - 1
    last = int(np.searchsorted(batch.stamps_ns, end_ns, side="left"))
    kept = slice(max(first, 0), last + 1)
    if batch.stamps_ns[kept].size == len(batch.stamps_ns):
        return batch
    return ImuBatch(
        stamps_ns=batch.stamps_ns[kept],
        gyro_radps=batch.gyro_radps[kept],
        accel_mps2=batch.accel_mps2[kept],
        is_saturated=None if batch.is_saturated is None else batch.is_saturated[kept],
        frame=batch.frame,
        T_base_sensor=batch.T_base_sensor,
    )
