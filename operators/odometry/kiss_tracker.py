"""KISS-ICP, guarded in front of what aborts the process, and judged before its map takes a scan in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from mapstream.operators.lidar.scan_shape import OpenDirections
from mapstream.operators.odometry.recent_voxels import RecentVoxels
from mapstream.operators.odometry.scan_motion import Sweep, is_plausible
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a scan must be to be believed."""

    min_points: int  # after sampling
    min_overlap: float  # of its points, in voxels that the last scans saw
    max_speed_mps: float
    max_rate_radps: float
    max_lost_scans: int  # in a row; then the local map starts anew at the predicted pose


class KissTracker:
    """The sensor's pose in the frame of its first scan, scan by scan."""

    def __init__(self, config: KISSConfig, limits: Limits) -> None:
        """Make a tracker; one thread, whatever the config says: more give another result each time."""
        config.registration.max_num_threads = 1
        self._icp = KissICP(config)
        self._limits = limits
        self._recent = RecentVoxels(2 * config.mapping.voxel_size)
        self._open_directions = OpenDirections()
        self._num_lost = 0
        self.has_map = False
        self.unseen: FloatArray = np.empty((0, 6))  # directions that the last scan left open

    @property
    def pose(self) -> SE3:
        return SE3(self._icp.last_pose)

    @property
    def threshold_m(self) -> float:
        """The adaptive threshold: how far off KISS-ICP holds its prediction to be."""
        return float(self._icp.adaptive_threshold.get_threshold())

    def track(self, sweep: Sweep, step_ns: int) -> None:
        """Move `pose` to the sweep's end: do what `KissICP.register_frame` does, but judge before the map is changed.

        Raises:
            EstimationError: If the sweep is not believed; then `pose` is the predicted one.
        """
        icp = self._icp
        predicted = icp.last_pose @ icp.last_delta
        try:
            self._register(sweep, step_ns, predicted)
        except EstimationError:
            self._num_lost += 1
            icp.last_pose = predicted
            raise
        self._num_lost = 0

    def _register(self, sweep: Sweep, step_ns: int, predicted: FloatArray) -> None:
        icp = self._icp
        times = np.empty(0) if sweep.offsets_ns is None else sweep.offsets_ns.astype(np.float64)
        frame = icp.preprocessor.preprocess(sweep.points, times, icp.last_delta)
        source, frame_downsample = icp.voxelize(frame)
        if len(source) < self._limits.min_points:
            raise EstimationError(
                f"{len(source)} points after sampling, at least {self._limits.min_points} needed"
            )
        sigma = icp.adaptive_threshold.get_threshold()
        pose = icp.registration.align_points_to_map(
            points=source,
            voxel_map=icp.local_map,
            initial_guess=predicted,
            max_correspondance_distance=3 * sigma,
            kernel=sigma,
        )
        self.unseen = self._open_directions.of(frame_downsample)
        moved = SE3(pose) @ source
        if self.has_map:
            try:
                self._judge(SE3(np.linalg.inv(icp.last_pose) @ pose), step_ns, moved)
            except EstimationError:
                if self._num_lost >= self._limits.max_lost_scans:
                    self._restart(frame_downsample, predicted, SE3(predicted) @ source)
                raise
        icp.adaptive_threshold.update_model_deviation(np.linalg.inv(predicted) @ pose)
        icp.local_map.update(frame_downsample, pose)
        icp.last_delta = np.linalg.inv(icp.last_pose) @ pose
        icp.last_pose = pose
        self._recent.add(moved)
        self.has_map = True

    def _judge(self, step: SE3, step_ns: int, moved: FloatArray) -> None:
        limits = self._limits
        if not is_plausible(step, step_ns, limits.max_speed_mps, limits.max_rate_radps):
            angle_deg = np.degrees(step.angle_rad)
            raise EstimationError(
                f"a jump of {np.linalg.norm(step.t):.2f} m and {angle_deg:.1f} deg"
            )
        overlap = self._recent.overlap(moved)
        if overlap < limits.min_overlap:
            raise EstimationError(
                f"overlap {overlap:.2f} with the scans before, at least {limits.min_overlap:.2f} needed"
            )

    def _restart(self, frame: FloatArray, pose: FloatArray, moved: FloatArray) -> None:
        self._icp.local_map.clear()
        self._icp.local_map.update(frame, pose)
        self._recent.clear()
        self._recent.add(moved)
