"""The cameras of KITTI odometry: rectified, without distortion, side by side.

P0: ... or four lines without names     3x4 projections, `K [I | t]`, of image_0 (grey, left) to image_3
Tr: ...                                 from the LiDAR to the left camera
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.datasets.image_files import image_files
from mapstream.recordings.maps.ids import derived_id
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, Sensor

LIDAR_FRAME = "velodyne"
_FOLDERS = {"image_0": 0, "image_1": 1, "image_2": 2, "image_3": 3, "image_l": 0, "image_r": 1}


@dataclass(frozen=True, slots=True)
class KittiCamera:
    """A folder of images; `camN` is their frame, as N is their number."""

    number: int
    files: list[Path]

    @property
    def name(self) -> str:
        return f"cam{self.number}"


def find_cameras(source: Path) -> list[KittiCamera]:
    """Return the cameras whose images are in a folder, by their numbers."""
    found = [
        KittiCamera(number, image_files(source / name))
        for name, number in _FOLDERS.items()
        if (source / name).is_dir()
    ]
    return sorted(found, key=lambda camera: camera.number)


class KittiCalibration:
    """A `calib.txt`: matrices (3, 4) by name; lines without one are P0, P1 ..."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            RecordingError: If it cannot be read.
        """
        self.path = path
        self._numbers: dict[str, str] = {}
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error}") from error
        for index, line in enumerate(filter(str.strip, lines)):
            name, colon, numbers = line.rpartition(":")
            self._numbers[name.strip() if colon else f"P{index}"] = numbers

    def projection(self, number: int) -> FloatArray:
        """Return `K [I | t]` (3, 4) of a camera.

        Raises:
            RecordingError: If the file does not say it.
        """
        return self._matrix(f"P{number}", "a camera's projection")

    def T_camera_lidar(self) -> SE3:
        """Return where the LiDAR sits, seen from the left camera.

        Raises:
            RecordingError: If the file does not say it.
        """
        name = "Tr_velo_cam" if "Tr_velo_cam" in self._numbers else "Tr"
        rows = self._matrix(name, "the LiDAR's place")
        try:
            return SE3(np.vstack([rows, [0, 0, 0, 1]]))
        except ValueError as error:
            raise RecordingError(f"{self.path}: {name}: {error}") from error

    def _matrix(self, name: str, what: str) -> FloatArray:
        if name not in self._numbers:
            raise RecordingError(
                f"{self.path}: expected a line '{name}: ...' with {what}, found"
                f" {', '.join(self._numbers) or 'none'}"
            )
        try:
            return np.array(self._numbers[name].split(), np.float64).reshape(3, 4)
        except ValueError as error:
            raise RecordingError(f"{self.path}: {name}: expected 12 numbers: {error}") from error


def read_rig(
    calibration: KittiCalibration,
    cameras: Sequence[KittiCamera],
    T_base_cam0: SE3,
    *,
    with_lidar: bool,
) -> Rig:
    """Return the cameras, seen from the LiDAR if there is one, from the left camera otherwise.

    Raises:
        RecordingError: If a camera's projection is missing or wrong.
    """
    lidar = Sensor(id=_id("lidar"), kind="lidar", topic="/points", frame=LIDAR_FRAME)
    sensors: list[Sensor] = [lidar] if with_lidar else []
    base = lidar.id if with_lidar else _id(cameras[0].name)
    places = [
        Extrinsics(sensor_id=lidar.id, base_sensor_id=base, T_base_sensor=SE3.identity())
    ] * with_lidar
    for camera in cameras:
        P = calibration.projection(camera.number)
        sensors.append(_sensor(camera, P))
        T_cam0_camera = SE3.from_rotation(np.eye(3), -np.linalg.solve(P[:, :3], P[:, 3]))
        place = Extrinsics(
            sensor_id=sensors[-1].id,
            base_sensor_id=base,
            T_base_sensor=T_base_cam0 @ T_cam0_camera,
        )
        places.append(place)
    return Rig(sensors, places)


def _sensor(camera: KittiCamera, P: FloatArray) -> CameraSensor:
    import cv2  # noqa: PLC0415  # heavy, and scans need none

    image = cv2.imread(str(camera.files[0]), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(f"{camera.files[0]}: expected an image, found something else")
    calibration = CameraCalibration(
        frame=camera.name,
        width_px=image.shape[1],
        height_px=image.shape[0],
        focal_px=P[[0, 1], [0, 1]],
        center_px=P[:2, 2],
        distortion_parameters=np.empty(0),
    )
    return CameraSensor(
        id=_id(camera.name),
        topic=f"/{camera.name}/image",
        frame=camera.name,
        calibration=calibration,
    )


def _id(name: str) -> str:
    return derived_id("sensor", "kitti", name).hex()
