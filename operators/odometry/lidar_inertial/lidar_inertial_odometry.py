"""Odometry from a LiDAR and an IMU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.odometry.lidar_inertial.starter import Starter
from mapstream.operators.odometry.lidar_inertial.state import LidarInertialState
from mapstream.operators.odometry.lidar_inertial.tracker import Tracked, Tracker, TrackerLimits
from mapstream.operators.odometry.resolution import Resolution
from mapstream.operators.odometry.scan_motion import Sweep
from mapstream.operators.odometry.uncertainty import unmeasured
from mapstream.operators.odometry.visual_inertial.samples import ImuSamples
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.trajectory.config import ImuConfig
from mapstream.operators.trajectory.rig_imu import described
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3, so3_exp, straightened
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import ImuBatch, LidarScan

_MAP_PER_SCAN = 0.5  # voxel of the map, as a part of that of the points that are fitted


class LidarInertialOdometryConfig(OperatorConfig):
    """Options of `lidar_inertial_odometry`."""

    imu: ImuConfig = ImuConfig()
    """Its noise and its limits; where it sits is taken from its samples."""
    voxel_size_m: PositiveFloat | None = None
    """Of the map; left out, it follows the size of the surroundings at the first scan."""
    scan_voxels: PositiveFloat = 2.0
    """The points that are fitted have voxels so many times as large."""
    max_range_m: PositiveFloat = 100.0
    """Farther returns are ignored, and so far the map reaches."""
    min_range_m: NonNegativeFloat = 0.5
    """Nearer ones too: the robot itself."""
    min_matched_fraction: float = Field(default=0.25, ge=0, le=1)
    """With fewer points on planes of the map a scan is not believed."""
    start_window_s: PositiveFloat = 1.5
    """A robot that does not stand is followed so long before the first odometry."""
    cloud_voxel_size_m: PositiveFloat = 0.25
    """Of the clouds that are sent on."""
    max_lost_scans: PositiveInt = 10
    """After so many lost scans the map starts anew where the IMU says."""


@dataclass(frozen=True)
class Inputs:
    """Scans with the time of each point; samples that cover them."""

    scans: Receiver[LidarScan]
    imu: Receiver[ImuBatch]


@dataclass(frozen=True)
class Outputs:
    """One each per scan from the start on, at the scan's end, with velocity and biases; z is up."""

    odometry: Sender[Odometry]
    clouds: Sender[PointCloud]


class LidarInertialOdometry(Operator[Inputs, Outputs]):
    """Estimate the motion of a robot from a LiDAR and an IMU: an iterated Kalman filter on a map of points.

    It starts where the robot stands, or after some scans in motion, which are held and estimated afterwards.
    The odom frame is the base at the first scan's end, made level. Each scan is straightened by the motion that
    the IMU says, and its points pulled to the planes of the map. Directions that no plane holds are left to the
    IMU, and have `UNOBSERVED_VARIANCE`, so that another sensor may take them.
    A scan that does not fit is predicted by the IMU and says so (`is_lost`).
    """

    placement: ClassVar[Placement] = "process"  # numpy on small matrices holds the GIL

    def __init__(self, config: LidarInertialOdometryConfig) -> None:
        self._config = config
        self._imu = described(config.imu)
        self._samples = ImuSamples(self._imu)
        self._starter = Starter(self._imu, self._samples, round(config.start_window_s * 1e9))
        self._resolution = Resolution(config.voxel_size_m)
        self._tracker: Tracker | None = None
        self._last_ns: int | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for scan in inputs.scans:
            await self._read_until(inputs.imu, scan.end_ns)
            for odometry, cloud in await offload(self.track, scan):
                await outputs.odometry.send(odometry)
                await outputs.clouds.send(cloud)
        for odometry, cloud in await offload(self.finish):
            await outputs.odometry.send(odometry)
            await outputs.clouds.send(cloud)

    def add_imu(self, batch: ImuBatch) -> None:
        """Take samples, before the scans that they cover."""
        self._samples.add(batch)

    def track(self, scan: LidarScan) -> list[tuple[Odometry, PointCloud]]:
        """Return the odometry and the cloud of a scan, and of those before it that were held."""
        sweep = Sweep.of(scan, self._config.min_range_m, self._config.max_range_m)
        if self._last_ns is not None and sweep.end_ns <= self._last_ns:
            warn("scans whose end does not come after the one before were left out")
            return []
        if self._samples.is_empty or sweep.start_ns < self._samples.start_ns:
            warn("scans before the first sample of the IMU were left out")
            return []
        self._last_ns = sweep.end_ns
        if self._tracker is not None:
            return [self._step(self._tracker, sweep)]
        state = self._starter.add(sweep, self._limits(sweep))
        return [] if state is None else self._started(state)

    def finish(self) -> list[tuple[Odometry, PointCloud]]:
        """Return what is still held, where the recording ends before the start."""
        if self._tracker is not None or not self._starter.held:
            return []
        state = self._starter.last_state()
        if state is None:
            warn("too few scans gave no start")
            return []
        return self._started(state)

    def _started(self, state: LidarInertialState) -> list[tuple[Odometry, PointCloud]]:
        """Return the messages of the scans that were held, now that the first state is known."""
        held = self._starter.held
        T_base_imu = self._samples.T_base_imu
        _place(state, T_base_imu.inverse())
        self._tracker = Tracker(state, self._samples, self._imu, self._limits(held[0]))
        messages = [self._step(self._tracker, sweep) for sweep in held]
        held.clear()
        return messages

    def _limits(self, sweep: Sweep) -> TrackerLimits:
        config = self._config
        voxel_size_m = self._resolution.update(sweep.points)
        return TrackerLimits(
            voxel_size_m=voxel_size_m,
            scan_voxel_size_m=config.scan_voxels * voxel_size_m,
            radius_m=config.max_range_m,
            min_matched_fraction=config.min_matched_fraction,
            max_lost_scans=config.max_lost_scans,
        )

    def _step(self, tracker: Tracker, sweep: Sweep) -> tuple[Odometry, PointCloud]:
        step_ns = sweep.end_ns - tracker.state.stamp_ns
        tracked = tracker.track(sweep)
        self._samples.forget(sweep.start_ns)
        is_lost = tracked.fit is None and step_ns > 0
        if is_lost:
            warn("scans that do not fit the map; the IMU alone says the motion there")
        odometry = self._odometry(tracker.state, tracked, step_ns, is_lost=is_lost)
        points = self._samples.T_base_imu @ tracked.points
        return odometry, sweep.cloud(points, self._config.cloud_voxel_size_m)

    def _odometry(
        self, state: LidarInertialState, tracked: Tracked, step_ns: int, *, is_lost: bool
    ) -> Odometry:
        """Return what the state says of the base."""
        T_base_imu = self._samples.T_base_imu
        T_imu_base = T_base_imu.inverse()
        covariance = unmeasured(step_ns / 1e9) if is_lost else None
        if tracked.fit is not None:
            adjoint = T_base_imu.adjoint()
            covariance = adjoint @ tracked.fit.seen.covariance @ adjoint.T
        rate = self._samples.between(state.stamp_ns, state.stamp_ns).gyro[-1] - state.gyro_bias
        return Odometry(
            stamp_ns=state.stamp_ns,
            T_odom_base=SE3(straightened((state.T_odom_imu @ T_imu_base).matrix)),
            covariance=covariance,
            velocity_mps=state.v + state.R @ np.cross(rate, T_imu_base.t),
            gyro_bias_radps=state.gyro_bias,
            accel_bias_mps2=state.accel_bias,
            is_lost=is_lost,
        )

    async def _read_until(self, imu: Receiver[ImuBatch], stamp_ns: int) -> None:
        while self._samples.end_ns < stamp_ns:
            batch = await anext(imu, None)
            if batch is None:
                return
            self.add_imu(batch)


def _place(state: LidarInertialState, T_imu_base: SE3) -> None:
    """Give a first state, whose place and heading are free, those by which the base is at the origin, and level."""
    ahead = state.R @ T_imu_base.R[:, 0]
    turn = so3_exp([0.0, 0.0, -np.arctan2(ahead[1], ahead[0])])
    state.R, state.v = turn @ state.R, turn @ state.v
    state.p = -state.R @ T_imu_base.t
