"""KITTI odometry: a folder of Velodyne scans, with times, calibration and poses where they are there.

    DIR/*.bin or DIR/velodyne/*.bin     float32 x y z reflectance
    DIR/times.txt                       a stamp [s] per scan; without it scans are 0.1 s apart
    DIR/calib.txt, DIR/poses*.txt       `Tr`, and the poses of the left camera, for `/truth`

The files hold no time per point, and none is invented: the clouds are deskewed in the odometry set.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    bin_files,
    drop_notice,
    read_bin,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import KITTI_PERIOD_NS, read_kitti, read_times
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan

_FRAME = "velodyne"


def convert_kitti(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/points`, and `/truth` (the LiDAR's pose) where poses and calibration are known."""
    velodyne = source / "velodyne"
    files = bin_files(velodyne if velodyne.is_dir() else source)
    stamps_ns, notices = _stamps(source, len(files))
    truth, truth_notices = _truth(source, stamps_ns)
    num_dropped = 0
    for index, (file, stamp_ns) in enumerate(zip(files, stamps_ns.tolist(), strict=True)):
        scan = read_bin(file)
        num_dropped += scan.num_dropped
        message = LidarScan(
            stamp_ns=stamp_ns, points=scan.points, intensity=scan.intensity, frame=_FRAME
        )
        writer.write("/points", message)
        if index < len(truth):
            writer.write("/truth", Odometry(stamp_ns=stamp_ns, T_odom_base=truth[index]))
        on_progress((index + 1) / len(files))
    return (*notices, *truth_notices, *drop_notice(num_dropped))


def _stamps(source: Path, count: int) -> tuple[IntArray, Notices]:
    times = source / "times.txt"
    if not times.exists():
        stamps_ns = np.arange(1, count + 1) * KITTI_PERIOD_NS  # zero would mean: no stamp
        return stamps_ns, (f"no {times.name}: stamps are nominal, 10 Hz",)
    stamps_ns = read_times(times)
    if len(stamps_ns) < count:
        raise RecordingError(
            f"{times}: expected a time for each of {count} scans, found {len(stamps_ns)}"
        )
    return stamps_ns[:count], ()


def _truth(source: Path, stamps_ns: IntArray) -> tuple[list[SE3], Notices]:
    """Return the LiDAR's poses, from its first one on."""
    poses_files = sorted(source.glob("poses*.txt"))
    if not poses_files:
        return [], ()
    calibration = source / "calib.txt"
    if not calibration.exists():
        return [], (
            f"no {calibration.name}: {poses_files[0].name} is of a camera and was left out",
        )
    T_camera_lidar = _lidar_in_camera(calibration)
    poses = read_kitti(poses_files[0]).poses[: len(stamps_ns)]
    T_lidar_camera = T_camera_lidar.inverse()
    return [T_lidar_camera @ SE3(T) @ T_camera_lidar for T in poses], ()


def _lidar_in_camera(calibration: Path) -> SE3:
    for line in calibration.read_text(encoding="utf-8").splitlines():
        name, _, values = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_cam"):
            try:
                rows = np.array(values.split(), dtype=np.float64).reshape(3, 4)
                return SE3(np.vstack([rows, [0, 0, 0, 1]]))
            except ValueError as error:
                raise RecordingError(f"{calibration}: Tr: expected 12 numbers: {error}") from error
    raise RecordingError(
        f"{calibration}: expected a line 'Tr: ...' with the LiDAR's place, found none"
    )
