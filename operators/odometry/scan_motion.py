"""What LiDAR odometries share: the points worth registering, the clouds and poses they send."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.operators.lidar.sampling import usable, voxel_indices
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import LidarScan, RecordRef

MAX_RANGE_M = 1e6  # beyond it nothing is a return


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The usable points of one scan, in the sensor's frame, each at its own time."""

    points: FloatArray  # (N, 3) [m]
    intensity: Float32Array | None  # (N,)
    offsets_ns: (
        IntArray | None
    )  # (N,) since start_ns; None where points have no time, or all the same
    start_ns: int
    end_ns: int
    T_base_sensor: SE3
    record: RecordRef | None

    @classmethod
    def of(
        cls, scan: LidarScan, min_range_m: float = 0.0, max_range_m: float = MAX_RANGE_M
    ) -> Sweep:
        """Take the finite points within range.

        Times that are all the same are taken for no times: KISS-ICP divides by their span, and aborts the
        process if that is zero.
        """
        is_usable = usable(scan.points, min_range_m, max_range_m)
        keep = slice(None) if is_usable.all() else np.flatnonzero(is_usable)
        offsets_ns = None if scan.offsets_ns is None else scan.offsets_ns[keep]
        if offsets_ns is not None and (not offsets_ns.size or np.ptp(offsets_ns) == 0):
            offsets_ns = None
        start_ns = scan.end_ns
        if offsets_ns is not None:
            start_ns = scan.stamp_ns + int(offsets_ns.min())
            offsets_ns = offsets_ns - offsets_ns.min()
        return cls(
            points=np.ascontiguousarray(scan.points[keep], dtype=np.float64),
            intensity=None if scan.intensity is None else scan.intensity[keep],
            offsets_ns=offsets_ns,
            start_ns=start_ns,
            end_ns=scan.end_ns,
            T_base_sensor=scan.T_base_sensor,
            record=scan.record,
        )

    def cloud(
        self,
        points_base: FloatArray,
        voxel_size_m: float,
        keep: npt.NDArray[np.bool_] | None = None,
    ) -> PointCloud:
        """Return a message of the sweep's points (N, 3), given in the base at its end: one per voxel."""
        kept = np.arange(len(points_base)) if keep is None else np.flatnonzero(keep)
        kept = kept[voxel_indices(points_base[kept], voxel_size_m)]
        return PointCloud(
            stamp_ns=self.end_ns,
            points=points_base[kept].astype(np.float32),
            intensity=None if self.intensity is None else self.intensity[kept],
            record=self.record,
        )


def is_plausible(step: SE3, step_ns: int, max_speed_mps: float, max_rate_radps: float) -> bool:
    """Tell whether a body could have moved so in that time; no time at all is taken as a tenth of a second."""
    duration_s = step_ns / 1e9 if step_ns > 0 else 0.1
    return (
        float(np.linalg.norm(step.t)) <= max_speed_mps * duration_s
        and step.angle_rad <= max_rate_radps * duration_s
    )
