"""The robots of W-MR: which sensors each has, where they sit, and what the recording says of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.recordings.worlds.satellites import T_BASE_ANTENNA
from mapstream.recordings.worlds.sensors import ImuConfig
from mapstream.recordings.worlds.truth import sensor_id
from mapstream.recordings.worlds.vi_rig import BASE, T_BASE_CAMERA, T_BASE_IMU, CameraName
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraMount, CameraRigSensor, CameraSensor, Sensor

RobotName = Literal["camera", "lidar", "rgbd", "full"]
STEREO: tuple[CameraName, ...] = ("front_left", "front_right")
# Turned, so that a forgotten extrinsic shows.
T_BASE_LIDAR = SE3.from_rotation(so3_exp([0.0, 0.0, 0.4]), [0.1, 0.0, 0.9])
# The camera's z is the base's x, turned downwards by 0.1 rad.
T_BASE_RGBD = SE3.from_rotation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3_exp([-0.1, -0.008, 0.005]),
    [0.04, 0.02, 0.03],
)
_T_BASE_MAST = SE3.from_rotation(np.eye(3), [0.15, 0.0, 1.2])


@dataclass(frozen=True, slots=True)
class Robot:
    """What a robot has. Its base is in the hand that carries it, or on the floor below it."""

    has_cameras: bool = False
    has_rgbd: bool = False
    has_imu: bool = False
    has_lidar: bool = False
    has_wheels: bool = False
    has_satellites: bool = False

    @property
    def has_sight(self) -> bool:
        return self.has_cameras or self.has_rgbd

    @property
    def is_carried(self) -> bool:
        return not self.has_wheels

    @property
    def cameras(self) -> dict[CameraName, SE3]:
        """Return T_base_camera of its stereo pair."""
        if not self.has_cameras:
            return {}
        below = SE3.identity() if self.is_carried else _T_BASE_MAST
        return {name: below @ T_BASE_CAMERA[name] for name in STEREO}


ROBOTS: dict[RobotName, Robot] = {
    "camera": Robot(has_cameras=True, has_imu=True),
    "lidar": Robot(has_lidar=True, has_wheels=True),
    "rgbd": Robot(has_rgbd=True),
    "full": Robot(
        has_cameras=True, has_imu=True, has_lidar=True, has_wheels=True, has_satellites=True
    ),
}


def mr_rig(
    robot: Robot, name: str, imu: ImuConfig, calibrations: Mapping[str, CameraCalibration]
) -> Rig:
    """Return what the recording says of the sensors of a robot, all of whose ids are its own.

    Args:
        robot: What it has.
        name: Of this one robot.
        imu: The noise of its IMU, if it has one.
        calibrations: Of its cameras, by frame.
    """

    def own(what: str) -> str:
        return sensor_id(f"{name}/{what}")

    base = Sensor(id=own(BASE), kind="odometry", topic="/odometry", frame=BASE)
    hung: list[tuple[Sensor, SE3]] = [(base, SE3.identity())]
    if robot.has_imu:
        hung.append((imu.sensor(own("imu")), T_BASE_IMU))
    if robot.has_lidar:
        lidar = Sensor(id=own("lidar"), kind="lidar", topic="/points", frame="lidar")
        hung.append((lidar, T_BASE_LIDAR))
    if robot.has_wheels:
        wheels = Sensor(id=own("wheels"), kind="wheel", topic="/wheels", frame="wheels")
        hung.append((wheels, SE3.identity()))
    if robot.has_satellites:
        antenna = Sensor(id=own("gnss"), kind="gps_wgs", topic="/gnss", frame="gnss")
        hung.append((antenna, T_BASE_ANTENNA))
    cameras = {
        frame: CameraSensor(
            id=own(frame), topic=f"/{frame}/image", frame=frame, calibration=calibration
        )
        for frame, calibration in calibrations.items()
    }
    if robot.has_cameras:
        mounts = tuple(
            CameraMount(camera=cameras[each], T_rig_camera=place)
            for each, place in robot.cameras.items()
        )
        pair = CameraRigSensor(id=own("cameras"), frame="cameras", mounts=mounts)
        hung.append((pair, SE3.identity()))
    if robot.has_rgbd:
        hung += [(camera, T_BASE_RGBD) for camera in cameras.values()]
    extrinsics = [
        Extrinsics(sensor_id=sensor.id, base_sensor_id=base.id, T_base_sensor=place)
        for sensor, place in hung
    ]
    return Rig([sensor for sensor, _ in hung], extrinsics, base_frame=BASE)
