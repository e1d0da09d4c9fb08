"""A room of points around rigs of cameras, with what a rig sees of it, true and false."""

from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.places.geometry.sightings import Sensor, Sightings, make_sightings
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3, so3_exp

CAMERA = CameraCalibration(
    width_px=752,
    height_px=480,
    focal_px=np.array([458.0, 457.0]),
    center_px=np.array([367.0, 248.0]),
    distortion="radtan",
    distortion_parameters=np.array([-0.28, 0.07, 0.0002, 0.00002]),
)
ROOM_M = np.array([10.0, 8.0, 3.0])  # x, y, z
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_base_camera


def camera(yaw_deg: float = 0.0) -> Sensor:
    """A camera on a ring around the base, looking out."""
    turn = SE3.exp([0, 0, np.deg2rad(yaw_deg), 0, 0, 0])
    return Sensor(T_base_sensor=turn @ SE3.from_rotation(_AHEAD, [0.1, 0, 0]), calibration=CAMERA)


def rig(num_cameras: int) -> tuple[Sensor, ...]:
    return tuple(camera(360.0 * k / num_cameras) for k in range(num_cameras))


def room_points(count: int, seed: int) -> FloatArray:
    """Points on the walls, the floor and the ceiling of a room around the origin (N, 3) [m]."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = np.where(rng.random(count) < 0.5, -0.5, 0.5)
    scaled: FloatArray = points * ROOM_M
    return scaled


def pose_in_room(rng: np.random.Generator) -> SE3:
    """A pose near the middle, upright to some degrees."""
    turn = [*rng.normal(0, 0.1, 2), rng.uniform(-np.pi, np.pi)]
    return SE3.from_rotation(so3_exp(turn), rng.uniform(-0.25, 0.25, 3) * ROOM_M)


@dataclass(frozen=True)
class Seen:
    sightings: Sightings
    is_true: np.ndarray  # (N,)


def look(
    sensors: tuple[Sensor, ...], T_map_base: SE3, points: FloatArray, *, sigma_px: float, seed: int
) -> Sightings:
    """What the cameras see of the points from a pose, with noise."""
    rng = np.random.default_rng(seed)
    found = []
    for number, sensor in enumerate(sensors):
        assert sensor.calibration is not None
        in_sensor = (T_map_base @ sensor.T_base_sensor).inverse() @ points
        px, is_seen = project(sensor.calibration, in_sensor)
        is_seen &= (px >= 0).all(axis=1) & (px < [752, 480]).all(axis=1)
        found.append((points[is_seen], px[is_seen], np.full(is_seen.sum(), number)))
    points_map, keypoints_px, sensor_of = (
        np.concatenate(each) for each in zip(*found, strict=True)
    )
    return make_sightings(
        sensors,
        sensor=sensor_of,
        points_map=points_map,
        keypoints_px=keypoints_px + rng.normal(0, sigma_px, keypoints_px.shape),
        points_sensor=np.full((len(sensor_of), 3), np.nan),
        sigmas_m=np.full(len(sensor_of), np.nan),
    )


def measured(
    T_map_base: SE3, points: FloatArray, *, sigma_m: float, seed: int, T_base_sensor: SE3
) -> Sightings:
    """What a sensor that measures 3D points sees of them, with noise."""
    noise = np.random.default_rng(seed).normal(0, sigma_m, points.shape)
    count = len(points)
    return make_sightings(
        (Sensor(T_base_sensor=T_base_sensor),),
        sensor=np.zeros(count, np.int64),
        points_map=points,
        keypoints_px=np.full((count, 2), np.nan),
        points_sensor=(T_map_base @ T_base_sensor).inverse() @ points + noise,
        sigmas_m=np.full(count, sigma_m),
    )


def with_outliers(sightings: Sightings, fraction: float, seed: int) -> Seen:
    """The same with some that are of other points of the room."""
    rng = np.random.default_rng(seed)
    is_true = rng.random(len(sightings)) >= fraction
    others = room_points(len(sightings), seed + 1)
    points_map = np.where(is_true[:, None], sightings.points_map, others)
    return Seen(replace(sightings, points_map=points_map), is_true)


def together(a: Sightings, b: Sightings) -> Sightings:
    """The sightings of two sets of sensors of one base."""

    def joined(name: str) -> FloatArray:
        both: FloatArray = np.concatenate([getattr(a, name), getattr(b, name)])
        return both

    return make_sightings(
        (*a.sensors, *b.sensors),
        sensor=np.concatenate([a.sensor, b.sensor + len(a.sensors)]),
        points_map=joined("points_map"),
        keypoints_px=joined("keypoints_px"),
        points_sensor=joined("points_sensor"),
        sigmas_m=joined("sigmas_m"),
    )
