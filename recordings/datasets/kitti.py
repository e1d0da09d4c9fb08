"""KITTI odometry: Velodyne scans, images or both, with times, calibration and poses where they are there.

    DIR/*.bin or DIR/velodyne/*.bin     float32 x y z reflectance
    DIR/image_0 to image_3              grey left, grey right, colour left, colour right; also image_l, image_r
    DIR/times.txt                       a stamp [s] per frame; without it frames are 0.1 s apart
    DIR/calib.txt                       `P0` to `P3`, `Tr`; needed for images
    DIR/poses*.txt                      poses of the left camera, for `/truth`

The LiDAR is the base; without scans the left camera is. The truth is the base's.
The files hold no time per point, and none is invented: the clouds are deskewed in the odometry set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    Topical,
    bin_files,
    drop_notice,
    read_bin,
)
from mapstream.recordings.datasets.image_files import image_of
from mapstream.recordings.datasets.kitti_cameras import (
    LIDAR_FRAME,
    KittiCalibration,
    KittiCamera,
    find_cameras,
    read_rig,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import KITTI_PERIOD_NS, read_kitti, read_times
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan


@dataclass(frozen=True, slots=True)
class _Sequence:
    """The parts of a folder."""

    scans: list[Path]
    cameras: list[KittiCamera]
    calibration: KittiCalibration | None

    def __len__(self) -> int:
        return len(self.scans or self.cameras[0].files)

    def T_base_cam0(self) -> SE3:
        """Return where the left camera sits."""
        if not self.scans or self.calibration is None:
            return SE3.identity()
        return self.calibration.T_camera_lidar().inverse()


def convert_kitti(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/points`, `/camN/image` and `/truth`, and attach the sensor file where there are images."""
    sequence = _find(source)
    if sequence.cameras and sequence.calibration is not None:
        rig = read_rig(
            sequence.calibration,
            sequence.cameras,
            sequence.T_base_cam0(),
            with_lidar=bool(sequence.scans),
        )
        attach_rig(writer, rig)
    stamps_ns, notices = _stamps(source, len(sequence))
    truth, truth_notices = _truth(source, sequence)
    num_dropped = 0
    for index, stamp_ns in enumerate(stamps_ns.tolist()):
        if sequence.scans:
            scan = read_bin(sequence.scans[index])
            num_dropped += scan.num_dropped
            message = LidarScan(
                stamp_ns=stamp_ns, points=scan.points, intensity=scan.intensity, frame=LIDAR_FRAME
            )
            writer.write("/points", message)
        for topic, image in _images(sequence.cameras, index, stamp_ns):
            writer.write(topic, image)
        if index < len(truth):
            writer.write("/truth", Odometry(stamp_ns=stamp_ns, T_odom_base=truth[index]))
        on_progress((index + 1) / len(sequence))
    return (*notices, *truth_notices, *drop_notice(num_dropped))


def _find(source: Path) -> _Sequence:
    cameras = find_cameras(source)
    velodyne = source / "velodyne"
    has_scans = velodyne.is_dir() or not cameras
    scans = bin_files(velodyne if velodyne.is_dir() else source) if has_scans else []
    counts = {camera.name: len(camera.files) for camera in cameras}
    counts |= {"scans": len(scans)} if scans else {}
    if len(set(counts.values())) != 1 or 0 in counts.values():
        found = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise RecordingError(f"{source}: expected as many images of each camera, found {found}")
    calibration = source / "calib.txt"
    if cameras and not calibration.is_file():
        raise RecordingError(
            f"{calibration}: expected the projections of the cameras, found no file"
        )
    return _Sequence(
        scans, cameras, KittiCalibration(calibration) if calibration.is_file() else None
    )


def _images(cameras: list[KittiCamera], index: int, stamp_ns: int) -> Iterator[Topical]:
    for camera in cameras:
        yield f"/{camera.name}/image", image_of(camera.files[index], stamp_ns, camera.name)


def _stamps(source: Path, count: int) -> tuple[IntArray, Notices]:
    times = source / "times.txt"
    if not times.exists():
        stamps_ns = np.arange(1, count + 1) * KITTI_PERIOD_NS  # zero would mean: no stamp
        return stamps_ns, (f"no {times.name}: stamps are nominal, 10 Hz",)
    stamps_ns = read_times(times)
    if len(stamps_ns) < count:
        raise RecordingError(
            f"{times}: expected a time for each of {count} frames, found {len(stamps_ns)}"
        )
    return stamps_ns[:count], ()


def _truth(source: Path, sequence: _Sequence) -> tuple[list[SE3], Notices]:
    """Return the base's poses, from its first one on."""
    poses_files = sorted(source.glob("poses*.txt"))
    if not poses_files:
        return [], ()
    if sequence.calibration is None:
        return [], (f"no calib.txt: {poses_files[0].name} is of a camera and was left out",)
    T_base_camera = sequence.T_base_cam0()
    T_camera_base = T_base_camera.inverse()
    poses = read_kitti(poses_files[0]).poses[: len(sequence)]
    return [T_base_camera @ SE3(T) @ T_camera_base for T in poses], ()
