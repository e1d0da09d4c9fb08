"""LiDAR odometry with KISS-ICP (Vizzo et al., RA-L 2023, doi:10.1109/LRA.2023.3236571)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import DataConfig, MappingConfig
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.deskew import deskew_by_velocity
from mapstream.operators.lidar.sampling import usable
from mapstream.operators.odometry.kiss_tracker import KissTracker, Limits
from mapstream.operators.odometry.scan_motion import Sweep
from mapstream.operators.odometry.uncertainty import diagonal, unmeasured
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import UNOBSERVED_VARIANCE, Odometry, PointCloud
from mapstream.streams.messages.sensors import LidarScan

_VOXEL_PER_RANGE = 0.1  # of the median range: a metre in a street
_FINEST_M, _COARSEST_M = 0.5, 1.0  # finer costs three times as much and drifts no less


class KissOdometryConfig(OperatorConfig):
    """Options of `kiss_odometry`."""

    voxel_size_m: PositiveFloat | None = None  # of the local map; None: by the first scan's ranges
    max_range_m: PositiveFloat = 100.0  # farther returns are ignored
    min_range_m: NonNegativeFloat = 0.0  # nearer ones too: the robot itself
    deskew: bool = True  # where points carry their time
    cloud_voxel_size_m: PositiveFloat = 0.25  # of the clouds that are sent on
    min_points: PositiveInt = 20  # fewer, after sampling, are not registered
    min_overlap: NonNegativeFloat = 0.25  # of a scan's voxels that the last scans saw too
    max_speed_mps: PositiveFloat = 50.0  # a faster step is taken for a failure
    max_rate_radps: PositiveFloat = 6.0
    max_lost_scans: PositiveInt = 5  # then the local map starts anew at the predicted pose
    sigma_rotation_rad: PositiveFloat = 0.002  # of one step; KISS-ICP itself gives no covariance
    sigma_translation_m: PositiveFloat = 0.02  # of one step; or a tenth of its adaptive threshold


@dataclass(frozen=True)
class Inputs:
    """Scans, with or without the time of each point."""

    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Outputs:
    """A pose and a cloud for every scan, both with the stamp of the scan's end."""

    odometry: Sender[Odometry]
    clouds: Sender[PointCloud]


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One scan after tracking."""

    odometry: Odometry
    sweep: Sweep
    step: SE3  # of the sensor, since the scan before
    step_ns: int  # zero for the first


class KissOdometry(Operator[Inputs, Outputs]):
    """Track a LiDAR against a local voxel map, assuming constant velocity.

    The odom frame is the base at the end of the first scan. KISS-ICP runs in the sensor's frame and its
    poses are moved to the base by the mounting of each scan, so a sensor that pans gives the base's path.
    A scan that cannot be registered (too few points, little overlap with the scans before, a jump) is
    reported: `is_lost`, the predicted pose, the covariance of no measurement, and a warning with its stamp.
    The covariance of a good step is constant, or grows with the adaptive threshold, by which KISS-ICP
    measures how far its prediction is off. A direction that the scan's surfaces do not hold, such as a blank
    corridor's axis, has `UNOBSERVED_VARIANCE`, so that another sensor may take it; the pose is KISS-ICP's own.
    In narrow places point-to-point ICP locks to the rings of the scan; `gicp_odometry` does not.
    """

    placement: ClassVar[Placement] = "process"  # KISS-ICP holds the GIL, and aborts on bad input

    def __init__(self, config: KissOdometryConfig) -> None:
        self._config = config
        self._tracker: KissTracker | None = None  # made for the ranges of the first good scan
        self._T_base_first = SE3.identity()  # where the sensor sat at that scan
        self._last_ns = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for scan in inputs.scans:
            tracked = await offload(self.register, scan)
            await outputs.odometry.send(tracked.odometry)
            if outputs.clouds.is_connected:
                await outputs.clouds.send(await offload(self.cloud, tracked))

    def register(self, scan: LidarScan) -> Tracked:
        """Align one scan."""
        sweep = Sweep.of(scan)
        tracker = self._tracker or KissTracker(self._kiss_config(sweep.points), self._limits())
        step_ns = sweep.end_ns - self._last_ns if tracker.has_map else 0
        before = tracker.pose
        is_lost = False
        try:
            tracker.track(sweep, step_ns)
            if self._tracker is None:
                self._tracker, self._T_base_first = tracker, sweep.T_base_sensor
        except EstimationError as error:
            is_lost = True
            warn(
                f"scan at {scan.stamp_ns} ns could not be registered: {error}; its step is predicted"
            )
        self._last_ns = sweep.end_ns
        T_odom_base = SE3.identity()
        if self._tracker is not None:
            T_odom_base = self._T_base_first @ tracker.pose @ sweep.T_base_sensor.inverse()
        covariance = self._covariance(tracker, sweep.T_base_sensor)
        odometry = Odometry(
            stamp_ns=sweep.end_ns,
            T_odom_base=T_odom_base,
            covariance=unmeasured(step_ns / 1e9) if is_lost else covariance,
            is_lost=is_lost,
        )
        return Tracked(odometry, sweep, before.inverse() @ tracker.pose, step_ns)

    def cloud(self, tracked: Tracked) -> PointCloud:
        """Deskew by the motion that was measured, not by the one before it, on which KISS-ICP relies."""
        config, sweep = self._config, tracked.sweep
        points = sweep.points
        if config.deskew and sweep.offsets_ns is not None and tracked.step_ns > 0:
            points = deskew_by_velocity(points, sweep.offsets_ns, tracked.step, tracked.step_ns)
        keep = usable(points, config.min_range_m, config.max_range_m)
        return sweep.cloud(sweep.T_base_sensor @ points, config.cloud_voxel_size_m, keep)

    def _kiss_config(self, points: FloatArray) -> KISSConfig:
        config = self._config
        voxel_size_m = config.voxel_size_m
        if voxel_size_m is None:
            median_m = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
            voxel_size_m = float(np.clip(_VOXEL_PER_RANGE * median_m, _FINEST_M, _COARSEST_M))
        return KISSConfig(
            data=DataConfig(
                max_range=config.max_range_m, min_range=config.min_range_m, deskew=config.deskew
            ),
            mapping=MappingConfig(voxel_size=voxel_size_m),
        )

    def _limits(self) -> Limits:
        return Limits(**self._config.model_dump(include=set(Limits.__dataclass_fields__)))

    def _covariance(self, tracker: KissTracker, T_base_sensor: SE3) -> FloatArray:
        config = self._config
        growth = max(1.0, tracker.threshold_m / 10 / config.sigma_translation_m)
        known = diagonal(growth * config.sigma_rotation_rad, growth * config.sigma_translation_m)
        unseen = tracker.unseen @ T_base_sensor.adjoint().T
        return known + UNOBSERVED_VARIANCE * unseen.T @ unseen
