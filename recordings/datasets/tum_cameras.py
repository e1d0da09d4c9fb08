"""The cameras of the TUM RGB-D data sets: published calibrations, or a settings file of ORB-SLAM."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mapstream.recordings.datasets.opencv_yaml import read_opencv_yaml
from mapstream.recordings.maps.ids import derived_id
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor

FRAME = "camera"
SIZE_PX = (640, 480)
_INTRINSICS = ("fx", "fy", "cx", "cy")
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_FREIBURG = {  # fx fy cx cy, k1 k2 p1 p2 k3, by the number of the camera
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}


def read_rig(folder: Path) -> tuple[Rig, tuple[str, ...]]:
    """Return the camera of a sequence, which is the base, and where its calibration is from.

    Raises:
        RecordingError: If neither a file nor the folder's name tells the calibration.
        ConfigError: If the file is wrong.
    """
    notices: tuple[str, ...] = ()
    settings = next((path for path in sorted(folder.glob("*.yaml")) if _is_settings(path)), None)
    if settings is not None:
        numbers = _of_settings(settings)
    else:
        number = re.search(r"(?:freiburg|fr)([123])", folder.resolve().name)
        if number is None:
            raise RecordingError(
                f"{folder}: expected a *.yaml with Camera.fx ..., or a name with freiburg1, 2 or 3, which tells"
                " the camera; found neither"
            )
        numbers = np.array(_FREIBURG[number[1]])
        notices = (f"the calibration is the published one of Freiburg {number[1]}",)
    is_bent = numbers[4:].any()
    calibration = CameraCalibration(
        frame=FRAME,
        width_px=SIZE_PX[0],
        height_px=SIZE_PX[1],
        focal_px=numbers[:2],
        center_px=numbers[2:4],
        distortion="radtan" if is_bent else "none",
        distortion_parameters=numbers[4:] if is_bent else np.empty(0),
    )
    sensor = CameraSensor(
        id=derived_id("sensor", "tum", FRAME).hex(),
        topic="/color/image",
        description="Kinect",
        frame=FRAME,
        calibration=calibration,
    )
    place = Extrinsics(sensor_id=sensor.id, base_sensor_id=sensor.id, T_base_sensor=SE3.identity())
    return Rig([sensor], [place]), notices


def _is_settings(path: Path) -> bool:
    return "Camera.fx:" in path.read_text(encoding="utf-8", errors="replace")


def _of_settings(path: Path) -> FloatArray:
    fields = read_opencv_yaml(path)
    intrinsics = [fields.number(f"Camera.{name}") for name in _INTRINSICS]
    return np.array(
        intrinsics + [fields.optional_number(f"Camera.{name}") or 0.0 for name in _DISTORTION]
    )
