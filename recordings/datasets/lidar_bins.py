"""A folder of deskewed scans (`*.bin`, float32 x y z intensity) and their poses in `alidarPose.csv`.

Each pose is a block of four lines with four numbers; the last number of a block is its stamp [s].
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
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
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, quat_xyzw_from_rotation
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan

POSES = "alidarPose.csv"


def convert_lidar_bins(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/points`, and the poses as `/reference`; scan k belongs to pose k."""
    files = bin_files(source)
    poses = read_pose_blocks(source / POSES)
    if len(poses) < len(files):
        raise RecordingError(
            f"{source / POSES}: expected a pose for each of {len(files)} scans, found {len(poses)}"
        )
    num_dropped = 0
    for index, pose in enumerate(poses):
        writer.write("/reference", pose)
        if index < len(files):
            scan = read_bin(files[index])
            num_dropped += scan.num_dropped
            message = LidarScan(
                stamp_ns=pose.stamp_ns, points=scan.points, intensity=scan.intensity
            )
            writer.write("/points", message)
        on_progress((index + 1) / len(poses))
    return drop_notice(num_dropped)


def read_pose_blocks(path: Path) -> list[Odometry]:
    """Read a file of 4x4 poses, whose last element is the stamp.

    Raises:
        RecordingError: If it is absent, or a block is no pose; with the line of the block.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    rows = [line.strip().rstrip(",").split(",") for line in lines if line.strip()]
    poses = []
    for start in range(0, len(rows), 4):
        try:
            words = np.array(rows[start : start + 4])
            R_t = words[:3].astype(np.float64)
            quat_xyzw = quat_xyzw_from_rotation(R_t[:, :3])  # six decimals: not quite orthogonal
            poses.append(
                Odometry(
                    stamp_ns=int(Decimal(str(words[3, 3])) * 10**9),
                    T_odom_base=SE3.from_quat_xyzw(quat_xyzw, R_t[:, 3]),
                )
            )
        except (ValueError, IndexError, InvalidOperation) as error:
            raise RecordingError(
                f"{path}:{start + 1}: expected four lines of four numbers: {error}"
            ) from error
    return poses
