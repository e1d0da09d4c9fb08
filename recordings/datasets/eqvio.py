"""EuRoC V1_01 as tracks of features and IMU: 30 s, from the file that the gtsam wheel carries.

    eqvio_processed_30s.csv     row_type,t_abs,...   rows of `meta`, `imu` (200 Hz), `vision_feature` (20 Hz)

Features of cam0 were tracked by the makers of the file (GIFT, for EqVIO: van Goor and Mahony, T-RO 2023) and are rays
on the plane z = 1, free of the lens's distortion: triangulated with the sequence's truth they fit to 1.0 px (median
of the tracks), and to 17 px if they are taken as distorted. Here they become pixels again, by the
published calibration of cam0, so that noise and image borders mean what they should.
Tracks that run over the border by some pixels are left as they are.
Source: gtsam's EqVIOReplayHelper; Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import groupby
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
from mapstream.recordings.datasets.kitti_inertial import gtsam_data
from mapstream.recordings.maps.ids import derived_id
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, ImuNoise, ImuSensor

IMU, FEATURES = "/imu", "/cam0/features"
_FRAME = "cam0"
_COLUMNS = ("gx", "gy", "gz", "ax", "ay", "az")
_SIZE_PX = (752, 480)
_DISTORTION = np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])  # of EuRoC's cam0
_NOISE = ImuNoise(  # of EuRoC's ADIS16448, as its sensor.yaml says
    gyro_density=1.6968e-4,
    gyro_random_walk=1.9393e-5,
    accel_density=2.0e-3,
    accel_random_walk=3.0e-3,
)


def eqvio_file() -> Path:
    """Return the file in the installed gtsam, without importing it.

    Raises:
        RecordingError: If gtsam is not installed.
    """
    return gtsam_data() / "eqvio_processed_30s.csv"


@dataclass(frozen=True, slots=True)
class _Tracks:
    """What the file holds, as it stands there."""

    meta: dict[str, str]
    imu_stamps_ns: IntArray  # (N,)
    imu: FloatArray  # (N, 6) gyroscope [rad/s], accelerometer [m/s^2]
    feature_stamps_ns: IntArray  # (M,)
    track_ids: IntArray  # (M,)
    rays: FloatArray  # (M, 2) on the plane z = 1 of the camera


def convert_eqvio(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/imu` and `/cam0/features`, and attach the sensor file."""
    tracks = _read(source)
    rig, calibration = _rig(source, tracks.meta)
    attach_rig(writer, rig)
    stamps_ns = tracks.imu_stamps_ns
    streams = (
        imu_batches(IMU, stamps_ns, tracks.imu[:, :3], tracks.imu[:, 3:]),
        _features(tracks, calibration),
    )
    write_in_order(writer, streams, (int(stamps_ns[0]), int(stamps_ns[-1])), on_progress)
    return ("the file holds no truth",)


def _read(path: Path) -> _Tracks:
    meta: dict[str, str] = {}
    imu: list[tuple[int, list[float]]] = []
    features: list[tuple[int, int, float, float]] = []
    with path.open(encoding="utf-8", newline="") as lines:
        for number, row in enumerate(csv.DictReader(lines), start=2):
            try:
                if row["row_type"] == "meta":
                    meta[row["key"]] = row["value"]
                elif row["row_type"] == "imu":
                    imu.append((_stamp_ns(row), [float(row[name]) for name in _COLUMNS]))
                elif row["row_type"] == "vision_feature":
                    ray = float(row["u_norm"]), float(row["v_norm"])
                    features.append((_stamp_ns(row), int(row["landmark_id"]), *ray))
            except (KeyError, TypeError, ValueError, InvalidOperation) as error:
                raise RecordingError(
                    f"{path}:{number}: expected a row of meta, imu or vision_feature: {error!r}"
                ) from error
    if not imu or not features:
        raise RecordingError(
            f"{path}: expected rows of imu and of vision_feature, found {len(imu)} and {len(features)}"
        )
    return _Tracks(
        meta=meta,
        imu_stamps_ns=np.array([stamp_ns for stamp_ns, _ in imu], np.int64),
        imu=np.array([values for _, values in imu]),
        feature_stamps_ns=np.array([feature[0] for feature in features], np.int64),
        track_ids=np.array([feature[1] for feature in features], np.int64),
        rays=np.array([feature[2:] for feature in features]),
    )


def _stamp_ns(row: dict[str, str]) -> int:
    """Return a stamp to the microsecond; the doubles that were written hold no more."""
    return int((Decimal(row["t_abs"]) * 10**6).to_integral_value()) * 1000


def _rig(path: Path, meta: dict[str, str]) -> tuple[Rig, CameraCalibration]:
    """Return the IMU and the camera that the file's first rows describe."""
    if meta.get("measurement_space") != "normalized":
        raise RecordingError(
            f"{path}: expected features with measurement_space normalized, found"
            f" {meta.get('measurement_space')!r}"
        )
    try:
        numbers = {name: float(meta[name]) for name in meta if name.startswith(("camera_", "T_ci"))}
        quat_xyzw = [numbers[f"T_ci_q{axis}"] for axis in "xyzw"]
        T_imu_camera = SE3.from_quat_xyzw(quat_xyzw, [numbers[f"T_ci_t{axis}"] for axis in "xyz"])
        calibration = CameraCalibration(
            frame=_FRAME,
            width_px=_SIZE_PX[0],
            height_px=_SIZE_PX[1],
            focal_px=np.array([numbers["camera_fx"], numbers["camera_fy"]]),
            center_px=np.array([numbers["camera_cx"], numbers["camera_cy"]]),
            distortion="radtan",
            distortion_parameters=_DISTORTION,
        )
    except (KeyError, ValueError) as error:
        raise RecordingError(f"{path}: expected rows of meta with the camera: {error}") from error
    imu_id, camera_id = (derived_id("sensor", "eqvio", name).hex() for name in ("imu", _FRAME))
    sensors = [
        ImuSensor(id=imu_id, topic=IMU, description="ADIS16448", frame="imu", noise=_NOISE),
        CameraSensor(id=camera_id, description="EuRoC cam0", frame=_FRAME, calibration=calibration),
    ]
    places = [
        Extrinsics(sensor_id=imu_id, base_sensor_id=imu_id, T_base_sensor=SE3.identity()),
        Extrinsics(sensor_id=camera_id, base_sensor_id=imu_id, T_base_sensor=T_imu_camera),
    ]
    return Rig(sensors, places), calibration


def _features(tracks: _Tracks, calibration: CameraCalibration) -> Iterator[Topical]:
    points = np.column_stack([tracks.rays, np.ones(len(tracks.rays))])
    keypoints_px, has_pixel = project(calibration, points)
    rows = [int(row) for row in np.flatnonzero(has_pixel)]
    stamps_ns = tracks.feature_stamps_ns.tolist()
    for stamp_ns, group in groupby(rows, key=lambda row: stamps_ns[row]):
        seen = list(group)
        message = ImageFeatures(
            stamp_ns=stamp_ns,
            kind="external",
            frame=_FRAME,
            keypoints_px=keypoints_px[seen].astype(np.float32),
            track_ids=tracks.track_ids[seen],
        )
        yield FEATURES, message
