"""LiDAR odometry with KISS-ICP (Vizzo et al., RA-L 2023, doi:10.1109/LRA.2023.3236571)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.deskew import deskew_by_velocity
from mapstream.operators.lidar.sampling import usable, voxel_keys
from mapstream.operators.odometry.scan_motion import Sweep, is_plausible
from mapstream.operators.odometry.uncertainty import diagonal, unmeasured
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import FloatArray, IntArray, LidarScan


class KissOdometryConfig(OperatorConfig):
    voxel_size_m: PositiveFloat = 1.0  # of the local map
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
    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Outputs:
    odometry: Sender[Odometry]  # one per scan, at the scan's end
    clouds: Sender[PointCloud]  # one per odometry, with its stamp


class KissOdometry(Operator[Inputs, Outputs]):
    """Track a LiDAR against a local voxel map, assuming constant velocity.

    The odom frame is the base at the end of the first scan. KISS-ICP runs in the sensor's frame and its
    poses are moved to the base by the mounting of each scan, so a sensor that pans gives the base's path.
    A scan that cannot be registered (too few points, little overlap with the scans before, a jump) is
    reported: `is_lost`, the predicted pose, the covariance of no measurement, and a warning with its stamp.
    The covariance of a good step is constant, or grows with the adaptive threshold, which KISS-ICP keeps at
    three sigma of how far its prediction was off.
    """

    placement: ClassVar[Placement] = "process"  # KISS-ICP holds the GIL, and aborts on bad input

    def __init__(self, config: KissOdometryConfig) -> None:
        self._config = config
        self._icp = KissICP(
            KISSConfig(
                data=DataConfig(
                    max_range=config.max_range_m,
                    min_range=config.min_range_m,
                    deskew=config.deskew,
                ),
                mapping=MappingConfig(voxel_size=config.voxel_size_m),
                # more threads give another result each time
                registration=RegistrationConfig(max_num_threads=1),
            )
        )
        self._recent = _RecentVoxels(2 * config.voxel_size_m)
        self._T_base_first: SE3 | None = None  # where the sensor sat at the first scan
        self._last_ns = 0
        self._num_lost = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for scan in inputs.scans:
            odometry, cloud = await offload(self.register, scan, bool(outputs.clouds.channels))
            await outputs.odometry.send(odometry)
            if cloud is not None:
                await outputs.clouds.send(cloud)

    def register(
        self,
        scan: LidarScan,
        with_cloud: bool = True,  # noqa: FBT001, FBT002  # offload passes by position
    ) -> tuple[Odometry, PointCloud | None]:
        """Align one scan; the cloud is made only where somebody reads it."""
        icp = self._icp
        sweep = Sweep.of(scan)
        is_first = self._T_base_first is None
        T_base_first = self._T_base_first or sweep.T_base_sensor
        step_ns = 0 if is_first else sweep.end_ns - self._last_ns
        before = icp.last_pose
        failure = self._align(sweep, step_ns, is_first=is_first)
        self._num_lost = self._num_lost + 1 if failure else 0
        if failure:
            warn(
                f"scan at {scan.stamp_ns} ns could not be registered: {failure}; its step is predicted"
            )
            icp.last_pose = before @ icp.last_delta
        if not (is_first and failure):
            self._T_base_first = T_base_first
        self._last_ns = sweep.end_ns
        step = SE3(np.linalg.inv(before) @ icp.last_pose)
        odometry = Odometry(
            stamp_ns=sweep.end_ns,
            T_odom_base=T_base_first @ SE3(icp.last_pose) @ sweep.T_base_sensor.inverse(),
            covariance=self._covariance(step_ns, is_lost=failure is not None),
            is_lost=failure is not None,
        )
        if not with_cloud:
            return odometry, None
        return odometry, self._cloud(sweep, step, step_ns)

    def _cloud(self, sweep: Sweep, step: SE3, step_ns: int) -> PointCloud:
        """Deskew by the motion that was measured, not by the one before it, on which KISS-ICP relies."""
        config, points = self._config, sweep.points
        if config.deskew and sweep.offsets_ns is not None and step_ns > 0:
            points = deskew_by_velocity(points, sweep.offsets_ns, step, step_ns)
        keep = usable(points, config.min_range_m, config.max_range_m)
        return sweep.cloud(sweep.T_base_sensor @ points, config.cloud_voxel_size_m, keep)

    def _align(self, sweep: Sweep, step_ns: int, *, is_first: bool) -> str | None:
        """Do what `KissICP.register_frame` does, but look at the pose before the map takes the scan.

        Returns why the scan could not be registered, if so.
        """
        icp, config = self._icp, self._config
        times = np.empty(0) if sweep.offsets_ns is None else sweep.offsets_ns.astype(np.float64)
        frame = icp.preprocessor.preprocess(sweep.points, times, icp.last_delta)
        source, frame_downsample = icp.voxelize(frame)
        if len(source) < config.min_points:
            return f"{len(source)} points after sampling, at least {config.min_points} needed"
        sigma = icp.adaptive_threshold.get_threshold()
        guess = icp.last_pose @ icp.last_delta
        pose = icp.registration.align_points_to_map(
            points=source,
            voxel_map=icp.local_map,
            initial_guess=guess,
            max_correspondance_distance=3 * sigma,
            kernel=sigma,
        )
        step = SE3(np.linalg.inv(icp.last_pose) @ pose)
        moved = SE3(pose) @ source
        if not is_first:
            failure = self._failure(step, step_ns, moved)
            if failure and self._num_lost < config.max_lost_scans:
                return failure
            if failure:
                self._restart(frame_downsample, guess, SE3(guess) @ source)
                return f"{failure}; the local map starts anew"
        icp.adaptive_threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        icp.local_map.update(frame_downsample, pose)
        icp.last_delta = np.linalg.inv(icp.last_pose) @ pose
        icp.last_pose = pose
        self._recent.add(moved)
        return None

    def _failure(self, step: SE3, step_ns: int, moved: FloatArray) -> str | None:
        config = self._config
        if not is_plausible(step, step_ns, config.max_speed_mps, config.max_rate_radps):
            angle_deg = np.degrees(step.angle_rad)
            return f"a jump of {np.linalg.norm(step.t):.2f} m and {angle_deg:.1f} deg"
        overlap = self._recent.overlap(moved)
        if overlap < config.min_overlap:
            return f"overlap {overlap:.2f} with the scans before, at least {config.min_overlap:.2f} needed"
        return None

    def _restart(self, frame: FloatArray, pose: FloatArray, moved: FloatArray) -> None:
        self._icp.local_map.clear()
        self._icp.local_map.update(frame, pose)
        self._recent.clear()
        self._recent.add(moved)

    def _covariance(self, step_ns: int, *, is_lost: bool) -> FloatArray:
        if is_lost:
            return unmeasured(step_ns / 1e9)
        config = self._config
        threshold_m = self._icp.adaptive_threshold.get_threshold()
        growth = max(1.0, threshold_m / 10 / config.sigma_translation_m)
        return diagonal(growth * config.sigma_rotation_rad, growth * config.sigma_translation_m)


class _RecentVoxels:
    """The voxels that the last few scans saw, to tell whether a scan lies where they were."""

    def __init__(self, voxel_size_m: float, num_scans: int = 5) -> None:
        self._voxel_size_m = voxel_size_m
        self._num_scans = num_scans
        self._scans: list[IntArray] = []
        self._seen: IntArray = np.empty(0, dtype=np.int64)

    def clear(self) -> None:
        self._scans, self._seen = [], np.empty(0, dtype=np.int64)

    def add(self, points: FloatArray) -> None:
        keys = np.unique(voxel_keys(points, self._voxel_size_m))
        self._scans = [*self._scans[1 - self._num_scans :], keys]
        self._seen = np.unique(np.concatenate(self._scans))

    def overlap(self, points: FloatArray) -> float:
        """Return the fraction of points in voxels that were seen; 1 where nothing was seen yet."""
        if not self._seen.size or not len(points):
            return 1.0
        keys = voxel_keys(points, self._voxel_size_m)
        found = np.searchsorted(self._seen, keys)
        hits = self._seen[np.minimum(found, len(self._seen) - 1)] == keys
        return float(hits.mean())
