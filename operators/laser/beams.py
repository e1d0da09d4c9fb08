"""Where the beams of a planar laser ended, as points of the base at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class BeamEnds:
    """Points that a sweep hit, in the order of its beams, in the base frame at the sweep's end."""

    stamp_ns: int  # the end of the sweep
    points: FloatArray  # (N, 3) [m]
    beams: IntArray  # (N,) number of each beam in the scan
    ranges_m: FloatArray  # (N,)

    def __len__(self) -> int:
        return len(self.points)


def hits(scan: LaserScan2D) -> IntArray:
    """Return the numbers (N,) of the beams that ended on something, within the range of the laser."""
    ranges = scan.ranges_m
    return np.flatnonzero((ranges >= scan.range_min_m) & (ranges <= scan.range_max_m))


def beam_ends(scan: LaserScan2D, way: Trajectory | None = None) -> BeamEnds:
    """Return what a sweep hit, each point moved to where it was seen from the base at the sweep's end.

    Args:
        scan: The sweep.
        way: Of the base in any frame that does not jump; without it, or where it does not cover the sweep,
            the robot counts as standing.
    """
    beams = hits(scan)
    ranges = scan.ranges_m[beams].astype(np.float64)
    angles = scan.angle_min_rad + beams * scan.angle_step_rad
    rays = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    points = scan.T_base_sensor @ (ranges[:, None] * rays)
    stamps_ns = scan.stamp_ns + beams * scan.beam_period_ns
    if way is not None and len(beams) and way.covers(scan.stamp_ns) and way.covers(scan.end_ns):
        T_end_then = invert(way.pose_at(scan.end_ns).matrix) @ way.at(stamps_ns)
        points = np.einsum("nij,nj->ni", T_end_then[:, :3, :3], points) + T_end_then[:, :3, 3]
    return BeamEnds(scan.end_ns, points, beams, ranges)
