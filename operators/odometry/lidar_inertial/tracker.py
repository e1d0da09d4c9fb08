"""Scan after scan: carried on by the IMU, straightened, fitted to the map, and taken into it.

Source: Xu et al., FAST-LIO2: Fast Direct LiDAR-inertial Odometry, T-RO 2022, figure 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.lidar.deskew import deskew_along
from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.odometry.lidar_inertial.plane_update import Fit, fit
from mapstream.operators.odometry.lidar_inertial.point_map import PointMap
from mapstream.operators.odometry.lidar_inertial.propagation import propagate, way_to
from mapstream.operators.odometry.lidar_inertial.state import LidarInertialState
from mapstream.operators.odometry.scan_motion import Sweep
from mapstream.operators.odometry.visual_inertial.samples import ImuSamples
from mapstream.streams.arrays import FloatArray
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerLimits:
    """How finely, how far, and what is believed."""

    voxel_size_m: float  # of the map
    scan_voxel_size_m: float  # of the points that are fitted
    radius_m: float  # of the map
    min_matched_fraction: float
    max_lost_scans: int


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One scan after tracking."""

    points: FloatArray  # (N, 3) in the IMU's frame at the scan's end, free of motion distortion [m]
    fit: Fit | None  # None: the IMU alone says where it is


class Tracker:
    """A state, and the map that it is kept in."""

    def __init__(
        self,
        state: LidarInertialState,
        samples: ImuSamples,
        imu: ImuQuality,
        limits: TrackerLimits,
    ) -> None:
        self.state = state
        self._samples = samples
        self._imu = imu
        self._limits = limits
        self._map = PointMap(limits.voxel_size_m, limits.radius_m)
        self._num_lost = 0

    def track(self, sweep: Sweep) -> Tracked:
        """Go on to the end of a sweep, which the samples cover; the first one, where the state is, begins the map."""
        path = self._path(sweep)
        T_imu_sensor = self._samples.T_base_imu.inverse() @ sweep.T_base_sensor
        points = T_imu_sensor @ sweep.points
        if sweep.offsets_ns is not None:
            points = deskew_along(points, sweep.start_ns + sweep.offsets_ns, path, sweep.end_ns)
        found = self._fit(points)
        if found is not None:
            self.state = found.state
        if found is not None or self._map.is_empty:
            near = points[np.linalg.norm(points, axis=1) < self._limits.radius_m]
            self._map.add(self.state.T_odom_imu @ near, self.state.p)
        return Tracked(points, found)

    def _fit(self, points: FloatArray) -> Fit | None:
        """Return the fit to the map, None if it is not believed; of too many such scans the last begins a new map."""
        if self._map.is_empty:
            return None
        chosen = points[voxel_indices(points, self._limits.scan_voxel_size_m)]
        found = fit(self.state, chosen, self._map)
        if found.matched_fraction >= self._limits.min_matched_fraction:
            self._num_lost = 0
            return found
        self._num_lost += 1
        if self._num_lost > self._limits.max_lost_scans:
            self._map.clear()
            self._num_lost = 0
        return None

    def _path(self, sweep: Sweep) -> Trajectory:
        """Carry the state on to the sweep's end; return where the IMU was, from the sweep's first point on."""
        state, known_ns = self.state, self.state.stamp_ns
        parts = []
        if sweep.start_ns < known_ns:
            parts.append(way_to(state, self._samples.between(sweep.start_ns, known_ns)))
        if sweep.end_ns > known_ns:
            parts.append(propagate(state, self._samples.between(known_ns, sweep.end_ns), self._imu))
        first = parts[0]
        for after in parts[1:]:
            first = Trajectory(
                stamps_ns=np.append(first.stamps_ns, after.stamps_ns[1:]),
                poses=np.concatenate([first.poses, after.poses[1:]]),
            )
        return first
