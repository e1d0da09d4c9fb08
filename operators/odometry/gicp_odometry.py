"""LiDAR odometry by registration to a local map, with small_gicp or a registration of one's own.

Source: Koide et al., small_gicp, JOSS 2024; the local map of keyframes is that of Chen et al., Direct
LiDAR Odometry, RA-L 2022, section III-D.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.deskew import deskew_along, deskew_by_velocity
from mapstream.operators.lidar.registration import (
    Registration,
    RegistrationResult,
    make_registration,
)
from mapstream.operators.odometry.gyro import GyroWindow, turning
from mapstream.operators.odometry.local_map import LocalMap
from mapstream.operators.odometry.resolution import Resolution
from mapstream.operators.odometry.scan_matcher import ScanMatcher
from mapstream.operators.odometry.scan_motion import Sweep, is_plausible
from mapstream.operators.odometry.uncertainty import unmeasured
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import ImuBatch, LidarScan
from mapstream.streams.trajectory import Trajectory

_BEND_LIMIT_M = 0.01  # about the noise of a range


class GicpOdometryConfig(OperatorConfig):
    registration: str = "gicp"
    """How scans are aligned: icp, plane, gicp, vgicp, or an installed registration."""
    registration_options: dict[str, Any] = Field(default_factory=dict)
    """Options of an installed registration."""
    voxel_size_m: PositiveFloat | None = None
    """Of the clouds that are aligned; left out, it follows the size of the surroundings."""
    search_distances_m: tuple[PositiveFloat, ...] = (2.0, 0.7)
    """How far apart matching points may lie, coarse to fine."""
    inlier_distance_m: PositiveFloat = 0.15
    """How far from the surface a point may lie to count as an inlier."""
    min_inlier_fraction: NonNegativeFloat = 0.4
    """With fewer inliers a step is not believed."""
    max_range_m: PositiveFloat = 100.0
    min_range_m: NonNegativeFloat = 0.5
    deskew: bool = True
    """Undo the motion within a scan, by the gyroscope where `imu` is connected, else by constant velocity."""
    num_keyframes: PositiveInt = 10
    """So many keyframes make the local map."""
    keyframe_distance_m: PositiveFloat = 1.5
    keyframe_angle_deg: PositiveFloat = 15.0
    cloud_voxel_size_m: PositiveFloat = 0.25
    """Of the clouds that are sent on."""
    max_speed_mps: PositiveFloat = 50.0
    """A faster step is taken for a failure."""
    max_rate_radps: PositiveFloat = 6.0
    max_lost_scans: PositiveInt = 5
    """After so many lost scans the local map starts anew at the predicted pose."""


@dataclass(frozen=True)
class Inputs:
    scans: Receiver[LidarScan]
    imu: Receiver[ImuBatch] | None = None


@dataclass(frozen=True)
class Outputs:
    odometry: Sender[Odometry]  # one per scan, at the scan's end
    clouds: Sender[PointCloud]  # one per odometry, with its stamp


class GicpOdometry(Operator[Inputs, Outputs]):
    """Track a LiDAR against the clouds of its last keyframes.

    The odom frame is the base at the end of the first scan. The motion is predicted by constant velocity
    and, where an IMU is connected, turned by the gyroscope. A fit that is not believed is searched for from
    other headings at a coarse resolution. If that fails too the step is reported: `is_lost`, the predicted
    pose, the covariance of no measurement, and a warning with its stamp.
    The covariance of a good step is that of the registration: its Hessian scaled by the residual. A direction
    that the surroundings do not hold, such as a blank corridor's axis, has `UNOBSERVED_VARIANCE`, so that
    another sensor may take it; the pose is the registration's, which moves along it by what it makes of noise.
    """

    placement: ClassVar[Placement] = "process"  # small_gicp holds the GIL

    def __init__(self, config: GicpOdometryConfig) -> None:
        self._config = config
        self._resolution = Resolution(config.voxel_size_m)
        self._matchers: dict[float, ScanMatcher] = {}  # by voxel size
        self._map = LocalMap(config.num_keyframes)
        self._T_odom_base = SE3.identity()
        self._velocity: FloatArray = np.zeros(6)  # tangent of the base, per second
        self._last_ns: int | None = None
        self._num_lost = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        gyro = GyroWindow(inputs.imu)
        async for scan in inputs.scans:
            batches = await gyro.until(scan.end_ns)
            odometry, cloud = await offload(self.register, scan, batches)
            gyro.forget(odometry.stamp_ns)
            await outputs.odometry.send(odometry)
            await outputs.clouds.send(cloud)

    def register(
        self, scan: LidarScan, batches: list[ImuBatch] | None = None
    ) -> tuple[Odometry, PointCloud]:
        """Align one scan to the local map; `batches` cover it and the time since the scan before."""
        config = self._config
        sweep = Sweep.of(scan, config.min_range_m, config.max_range_m)
        step_ns = 0 if self._last_ns is None else sweep.end_ns - self._last_ns
        start_ns = min(sweep.start_ns, sweep.end_ns - step_ns)
        motion = turning(batches or [], start_ns, sweep.end_ns, self._velocity[3:])
        step = self._predicted(step_ns, sweep.end_ns, motion)
        points = self._deskewed(sweep, step, step_ns, motion)
        result = None
        try:
            result = self._align(points, step, step_ns)
            measured = self._T_odom_base.inverse() @ result.T_target_source
            if self._is_bent(sweep, step, measured, motion):
                # the prediction removed most of the distortion, what was measured removes the rest
                step = measured
                points = self._deskewed(sweep, step, step_ns, None)
                result = self._align(points, step, step_ns)
        except EstimationError as error:
            warn(
                f"scan at {scan.stamp_ns} ns could not be registered: {error}; its step is predicted"
            )
        return self._finish(sweep, points, step, step_ns, result)

    def _predicted(self, step_ns: int, end_ns: int, motion: Trajectory | None) -> SE3:
        if motion is not None and step_ns > 0:
            return motion.between(end_ns - step_ns, end_ns)
        return SE3.exp(self._velocity * (step_ns / 1e9))

    def _is_bent(self, sweep: Sweep, step: SE3, measured: SE3, motion: Trajectory | None) -> bool:
        """Return whether deskewing by this step, not by the measured one, has left a distortion that counts."""
        if motion is not None or sweep.offsets_ns is None or self._last_ns is None:
            return False
        difference = step.inverse() @ measured
        reach_m = float(np.median(np.linalg.norm(sweep.points, axis=1)))
        bend_m = float(np.linalg.norm(difference.t)) + difference.angle_rad * reach_m
        return bend_m > _BEND_LIMIT_M

    def _deskewed(
        self, sweep: Sweep, step: SE3, step_ns: int, motion: Trajectory | None
    ) -> FloatArray:
        """Return the points in the base frame at the sweep's end."""
        points = sweep.T_base_sensor @ sweep.points
        if not self._config.deskew or sweep.offsets_ns is None:
            return points
        if motion is not None:
            return deskew_along(points, sweep.start_ns + sweep.offsets_ns, motion, sweep.end_ns)
        return (
            deskew_by_velocity(points, sweep.offsets_ns, step, step_ns) if step_ns > 0 else points
        )

    def _align(self, points: FloatArray, step: SE3, step_ns: int) -> RegistrationResult:
        config = self._config
        target = self._map.points if len(self._map.points) else points
        voxel_size_m = self._resolution.update(points)
        if voxel_size_m not in self._matchers:
            self._matchers[voxel_size_m] = _matcher(config, voxel_size_m)
        T_last = self._T_odom_base
        result = self._matchers[voxel_size_m].match(points, target, T_last @ step, T_last)
        moved = T_last.inverse() @ result.T_target_source
        if not is_plausible(moved, step_ns, config.max_speed_mps, config.max_rate_radps):
            angle_deg = np.degrees(moved.angle_rad)
            raise EstimationError(
                f"a jump of {np.linalg.norm(moved.t):.2f} m and {angle_deg:.1f} deg"
            )
        return result

    def _finish(
        self,
        sweep: Sweep,
        points: FloatArray,
        step: SE3,
        step_ns: int,
        result: RegistrationResult | None,
    ) -> tuple[Odometry, PointCloud]:
        """Take the new pose over, keep the scan if it is a keyframe, and make the messages."""
        before, config = self._T_odom_base, self._config
        self._T_odom_base = before @ step if result is None else result.T_target_source
        self._num_lost = self._num_lost + 1 if result is None else 0
        if result is not None and step_ns > 0:
            self._velocity = (before.inverse() @ self._T_odom_base).log() / (step_ns / 1e9)
        self._last_ns = sweep.end_ns
        is_restart = self._num_lost > config.max_lost_scans
        if is_restart:
            self._map.clear()
        if is_restart or (result is not None and self._is_keyframe()):
            self._map.add(points, self._T_odom_base, self._resolution.update(points))
        odometry = Odometry(
            stamp_ns=sweep.end_ns,
            T_odom_base=self._T_odom_base,
            covariance=unmeasured(step_ns / 1e9) if result is None else result.covariance,
            velocity_mps=self._T_odom_base.R @ self._velocity[3:],
            is_lost=result is None,
        )
        return odometry, sweep.cloud(points, config.cloud_voxel_size_m)

    def _is_keyframe(self) -> bool:
        if not len(self._map.points):
            return True
        distance_m, angle_rad = self._map.distance_to_last(self._T_odom_base)
        config = self._config
        return distance_m >= config.keyframe_distance_m or bool(
            np.degrees(angle_rad) >= config.keyframe_angle_deg
        )


def _matcher(config: GicpOdometryConfig, voxel_size_m: float) -> ScanMatcher:
    def registration(factor: float, distances_m: tuple[float, ...]) -> Registration:
        """Make the one that the config names, at a resolution."""
        return make_registration(
            config.registration,
            config.registration_options,
            leaf_size_m=factor * voxel_size_m,
            search_distances_m=tuple(factor * d for d in distances_m),
            inlier_distance_m=factor * config.inlier_distance_m,
        )

    return ScanMatcher(
        near=registration(1.0, config.search_distances_m[-1:]),
        far=registration(1.0, config.search_distances_m),
        coarse=registration(3.0, config.search_distances_m),
        min_inlier_fraction=config.min_inlier_fraction,
    )
