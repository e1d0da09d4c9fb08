"""Matching of planar scans against small_gicp's ICP on the same points: `python benchmarks/laser.py`.

Scans are those of a lap through W-2D. Each is matched to what its predecessor saw, from 0.1 m and 3 degrees off, which
is more than odometry leaves. Both sides get the points, and prepare target and source anew for each pair: ours fits lines
and builds a tree; small_gicp, with one thread, builds a tree and iterates point to point, since the planes it could fit in
space are not defined by points that lie flat. Times are of the processor, since other work on a machine slows both.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import small_gicp

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.laser_odometry import LaserOdometry, LaserOdometryConfig
from mapstream.operators.laser.matching import LineTarget, match
from mapstream.operators.laser.planar import difference, flattened, lifted, perturbed
from mapstream.operators.laser.surfaces import surface_of
from mapstream.recordings.worlds.planar_laser import PlanarLaserConfig
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory

BEAMS = (181, 361)
NUM_PAIRS = 150
OFF = np.array([np.radians(3), 0.08, -0.06])  # [rad, m, m]
EYE = np.zeros(2)


def _scans(beams: int) -> tuple[list[LaserScan2D], Trajectory]:
    config = W2dConfig(
        width_m=14.0, laps=1, visits=False, laser=PlanarLaserConfig(beams=beams, rate_hz=5)
    )
    messages = [record.message for record in w_2d(config, seed=0).records]
    truth = [m for m in messages if isinstance(m, Odometry)]
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in truth]),
        poses=np.array([m.T_odom_base.matrix for m in truth]),
    )
    scans = [m for m in messages if isinstance(m, LaserScan2D)]
    return [s for s in scans if way.covers(s.stamp_ns) and way.covers(s.end_ns)][:NUM_PAIRS], way


def _by_lines(source: FloatArray, target: FloatArray, guess: FloatArray) -> FloatArray:
    surfaces = [surface_of(np.ascontiguousarray(p[:, :2]), EYE) for p in (source, target)]
    return match(surfaces[0], LineTarget(surfaces[1]), guess).pose


def _by_icp(source: FloatArray, target: FloatArray, guess: FloatArray) -> FloatArray:
    clouds = [small_gicp.PointCloud(points) for points in (target, source)]
    found = small_gicp.align(
        *clouds,
        small_gicp.KdTree(clouds[0], 1),
        init_T_target_source=lifted(guess).matrix,
        registration_type="ICP",
        max_correspondence_distance=0.5,
        num_threads=1,
        max_iterations=40,
    )
    return flattened(SE3(found.T_target_source))


Aligner = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


def _measured(align: Aligner, points: list[FloatArray], steps: list[FloatArray]) -> FloatArray:
    """Return the seconds of the processor for each pair, and the median error [m]."""
    started_s = time.process_time()
    found = [
        align(b, a, perturbed(step, OFF))
        for a, b, step in zip(points, points[1:], steps, strict=False)
    ]
    each_s = (time.process_time() - started_s) / len(found)
    errors = [np.linalg.norm(difference(e, f)[1:]) for e, f in zip(steps, found, strict=True)]
    return np.array([each_s, np.median(errors)])


def _matching(beams: int) -> Row:
    scans, way = _scans(beams)
    points = [beam_ends(scan, way).points for scan in scans]
    poses = [way.pose_at(scan.end_ns) for scan in scans]
    steps = [flattened(a.inverse() @ b) for a, b in pairwise(poses)]
    ours, icp = (_measured(align, points, steps) for align in (_by_lines, _by_icp))
    return Row(
        what=f"match {beams} beams to the scan before",
        ours=f"{1 / ours[0]:.0f} Hz, {1000 * ours[1]:.1f} mm",
        other=f"small_gicp's ICP: {1 / icp[0]:.0f} Hz, {1000 * icp[1]:.1f} mm",
        ratio=icp[0] / ours[0],
        bar="at least 40 Hz",
    )


def _odometry(beams: int) -> Row:
    scans, way = _scans(beams)
    points = [beam_ends(scan, way).points for scan in scans]
    icp_s = _measured(_by_icp, points, [np.zeros(3)] * (len(points) - 1))[0]
    operator = LaserOdometry(LaserOdometryConfig())
    started_s = time.process_time()
    for scan in scans:
        operator.register(scan)
    ours_s = (time.process_time() - started_s) / len(scans)
    return Row(
        what=f"`laser_odometry`, {beams} beams to the last keyframes",
        ours=f"{1 / ours_s:.0f} Hz",
        other=f"small_gicp's ICP to one scan: {1 / icp_s:.0f} Hz",
        ratio=icp_s / ours_s,
        bar="at least 40 Hz",
    )


def run() -> list[Row]:
    """Return the rows of this benchmark."""
    return [_matching(beams) for beams in BEAMS] + [_odometry(beams) for beams in BEAMS]


if __name__ == "__main__":
    print(markdown(run()))
