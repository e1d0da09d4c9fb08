"""The surroundings that a scan is registered to: the clouds of the last keyframes, in the odom frame."""

from __future__ import annotations

from collections import deque

import numpy as np

from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3


class LocalMap:
    """Merged clouds of the last keyframes; `points` is a new array whenever it changes."""

    def __init__(self, num_keyframes: int) -> None:
        self._clouds: deque[FloatArray] = deque(maxlen=num_keyframes)
        self._T_odom_last = SE3.identity()
        self.points: FloatArray = np.empty((0, 3))

    def clear(self) -> None:
        self._clouds.clear()
        self.points = np.empty((0, 3))

    def add(self, points: FloatArray, T_odom_base: SE3, voxel_size_m: float) -> None:
        """Take a cloud (N, 3) in the base frame in, and let the oldest go."""
        self._clouds.append(T_odom_base @ points)
        self._T_odom_last = T_odom_base
        merged = np.concatenate(list(self._clouds))[::-1]  # of two in a voxel the newer stays
        self.points = merged[voxel_indices(merged, voxel_size_m)]

    def distance_to_last(self, T_odom_base: SE3) -> tuple[float, float]:
        """Return metres and radians from the newest keyframe."""
        motion = self._T_odom_last.inverse() @ T_odom_base
        return float(np.linalg.norm(motion.t)), motion.angle_rad
