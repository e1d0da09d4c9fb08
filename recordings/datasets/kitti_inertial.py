"""KITTI 00 as IMU and satellite positions: 470 s of a drive, from the files that the gtsam wheel carries.

    KittiEquivBiasedImu.txt            Time dt accelX accelY accelZ omegaX omegaY omegaZ   [s, m/s^2, rad/s]
    KittiEquivBiasedImu_metadata.txt   the IMU's place, and its noise as densities
    KittiGps_converted.txt             Time,X,Y,Z   metres in a local frame with z up
    VO_camera_poses00.txt              poses of the left camera, optical axes, for the first 16 s

Stamps are seconds of the day (12:55:34). Base and IMU are one: x forward, y left, z up.
The poses of the camera bear numbers of frames, not times: their clock was found by comparing their yaw rate with
the gyroscope's, which agree to 0.011 rad/s rms.
Source: Geiger et al., KITTI, IJRR 2013; variance of the positions from gtsam's IMUKittiExampleGPS.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    Topical,
    imu_batches,
    write_in_order,
)
from mapstream.recordings.maps.ids import derived_id
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.number_tables import read_table
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, quat_xyzw_from_rotation
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import ImuNoise, ImuSensor

IMU, FIXES, CAMERA = "/imu", "/gps", "/visual_odometry"
IMU_FILE = "KittiEquivBiasedImu.txt"
NOISE_FILE = "KittiEquivBiasedImu_metadata.txt"
FIXES_FILE = "KittiGps_converted.txt"
CAMERA_FILE = "VO_camera_poses00.txt"
_POSITION_VARIANCE_M2 = 0.07
_MAX_GAP_S = 0.1  # of the IMU
_FRAME_PERIOD_S = 0.1036
_FIRST_FRAME_S = 0.54  # after the first line of the IMU
_R_BASE_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def gtsam_data() -> Path:
    """Return the folder of examples in the installed gtsam, without importing it.

    Raises:
        RecordingError: If gtsam is not installed.
    """
    spec = find_spec("gtsam")
    if spec is None or spec.origin is None:
        raise RecordingError("gtsam is not installed; its wheel carries the files of KITTI 00")
    return Path(spec.origin).parent / "Data"


@dataclass(frozen=True, slots=True)
class _Imu:
    rows: FloatArray  # (N, 8) as in the file, without gaps
    first_line_s: float
    num_left_out: int


def convert_kitti_inertial(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/imu`, `/gps` and `/visual_odometry`, and attach the sensor file.

    What lies before the IMU runs without gaps is left out; so are the camera's tracks, which no message fits.
    """
    imu = _read_imu(source / IMU_FILE)
    attach_rig(writer, _read_rig(source / NOISE_FILE))
    fixes = read_table(source / FIXES_FILE, 4, separator=",", header=1)
    start_s, end_s = imu.rows[0, 0], imu.rows[-1, 0]
    is_within = (fixes[:, 0] >= start_s) & (fixes[:, 0] <= end_s)
    stamps_ns = np.round(imu.rows[:, 0] * 1e9).astype(np.int64)
    streams = (
        imu_batches(IMU, stamps_ns, imu.rows[:, 5:8], imu.rows[:, 2:5]),
        _positions(fixes[is_within]),
        _camera_poses(source / CAMERA_FILE, imu),
    )
    write_in_order(writer, streams, (int(stamps_ns[0]), int(stamps_ns[-1])), on_progress)
    notices = []
    num_fixes = int((~is_within).sum())
    if imu.num_left_out or num_fixes:
        notices.append(
            f"{imu.num_left_out} IMU samples and {num_fixes} positions before the IMU runs without"
            f" gaps ({start_s - imu.first_line_s:.2f} s) were left out"
        )
    notices.append("the camera's tracks (VO_stereo_factors) were left out: no message holds tracks")
    return tuple(notices)


def _read_imu(path: Path) -> _Imu:
    rows = read_table(path, 8, header=1)
    steps_s = np.diff(rows[:, 0])
    backwards = np.flatnonzero(steps_s <= 0)
    if len(backwards):
        raise RecordingError(f"{path}:{backwards[0] + 3}: times must increase")
    gaps = np.flatnonzero(steps_s > _MAX_GAP_S)
    first = int(gaps[-1]) + 1 if len(gaps) else 0
    return _Imu(rows[first:], float(rows[0, 0]), first)


def _read_rig(path: Path) -> Rig:
    row: list[float] = read_table(path, 12, header=1)[0].tolist()
    imu = ImuSensor(
        id=derived_id("sensor", "kitti", "imu").hex(),
        topic=IMU,
        description="OXTS RT 3003",
        frame="imu",
        noise=ImuNoise(
            accel_density=row[6],
            gyro_density=row[7],
            accel_random_walk=row[9],
            gyro_random_walk=row[10],
        ),
    )
    if any(row[:6]):
        raise RecordingError(f"{path}: expected the IMU at the base, found it at {row[:6]}")
    place = Extrinsics(sensor_id=imu.id, base_sensor_id=imu.id, T_base_sensor=SE3.identity())
    return Rig([imu], [place])


def _positions(fixes: FloatArray) -> Iterator[Topical]:
    frame = OuterFrame(name="gps")
    covariance = np.diag([np.inf] * 3 + [_POSITION_VARIANCE_M2] * 3)
    for time_s, *position in fixes.tolist():
        yield (
            FIXES,
            Constraint(
                stamp_ns=round(time_s * 1e9),
                kind="position",
                T_a_b=SE3.from_rotation(np.eye(3), position),
                covariance=covariance,
                outer=frame,
                source="gps",
            ),
        )


def _camera_poses(path: Path, imu: _Imu) -> Iterator[Topical]:
    """Yield the camera's poses, turned to the robot's axes, from where the IMU runs on."""
    rows = read_table(path, 17)
    times_s = imu.first_line_s + _FIRST_FRAME_S + rows[:, 0] * _FRAME_PERIOD_S
    T_base_camera = SE3.from_rotation(_R_BASE_CAMERA)
    for time_s, pose in zip(times_s.tolist(), rows[:, 1:].reshape(-1, 4, 4), strict=True):
        if time_s < imu.rows[0, 0]:
            continue
        T_camera = SE3.from_quat_xyzw(quat_xyzw_from_rotation(pose[:3, :3]), pose[:3, 3])
        T_odom_base = T_base_camera @ T_camera @ T_base_camera.inverse()
        yield CAMERA, Odometry(stamp_ns=round(time_s * 1e9), T_odom_base=T_odom_base)
