"""What a world says of itself: its own motion and places, for whoever compares; and ids of its sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from hashlib import md5

import numpy as np

from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.sensors import ImuSeries
from mapstream.streams.arrays import IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import TransformBatch

_RATE_HZ = 100.0


def sensor_id(name: str) -> str:
    """Return the id of a sensor: 32 hex digits of its name."""
    return md5(name.encode(), usedforsecurity=False).hexdigest()


def stamps_at(rate_hz: float, span_ns: tuple[int, int]) -> IntArray:
    """Return stamps from the start to the end; none at a rate of 0."""
    if rate_hz == 0:
        return np.empty(0, np.int64)
    num = int((span_ns[1] - span_ns[0]) * rate_hz / 1e9 + 1e-6) + 1
    stamps: IntArray = span_ns[0] + np.rint(np.arange(num) * (1e9 / rate_hz)).astype(np.int64)
    return stamps


def true_odometry(
    motion: Motion, imu: ImuSeries | None, span_ns: tuple[int, int]
) -> Iterator[Odometry]:
    """Yield poses of the base in the world, its velocities there, and the IMU's biases if there is one."""
    stamps_ns = stamps_at(_RATE_HZ, span_ns)
    poses, velocities = motion.poses(stamps_ns), motion.velocities(stamps_ns)
    for stamp_ns, T, velocity in zip(stamps_ns.tolist(), poses, velocities, strict=True):
        gyro, accel = (None, None) if imu is None else imu.biases_at(stamp_ns)
        yield Odometry(
            stamp_ns=stamp_ns,
            T_odom_base=SE3(T),
            velocity_mps=velocity,
            gyro_bias_radps=gyro,
            accel_bias_mps2=accel,
        )


def true_places(T_world_thing: Mapping[str, SE3], stamp_ns: int) -> TransformBatch:
    """Return where things are in the world, by their names."""
    return TransformBatch(
        stamps_ns=np.full(len(T_world_thing), stamp_ns),
        parents=("world",) * len(T_world_thing),
        children=tuple(T_world_thing),
        T_parent_child=np.stack([place.matrix for place in T_world_thing.values()]),
        is_static=True,
    )
