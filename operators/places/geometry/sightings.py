"""What one frame might see of a map: points there, and the rays or 3D points of the sensors here."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.geometry import SE3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensor:
    """Where a sensor sits, and how it sees; one that measures 3D points needs no calibration."""

    T_base_sensor: SE3
    calibration: CameraCalibration | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Keypoints of one moment, of all sensors, each with the landmark that it may be of."""

    sensors: tuple[Sensor, ...]
    sensor: IntArray  # (N,) which of them
    points_map: FloatArray  # (N, 3) of the landmarks [m]
    keypoints_px: FloatArray  # (N, 2)
    points_sensor: FloatArray  # (N, 3) [m]; NaN where only a ray is known
    sigmas_m: FloatArray  # (N,) of these; NaN where none is known
    rays: FloatArray  # (N, 3) units, in the sensor's frame; NaN without a camera
    rad_per_px: FloatArray  # (N,) how far a ray turns over a pixel

    def __len__(self) -> int:
        return len(self.sensor)

    @property
    def has_point(self) -> BoolArray:
        """Which are 3D points (N,); they are not used as rays."""
        return np.isfinite(self.points_sensor[:, 0])

    @property
    def has_ray(self) -> BoolArray:
        """Which are rays alone (N,)."""
        return np.isfinite(self.rad_per_px) & ~self.has_point

    def points_base(self) -> FloatArray:
        """Return the 3D points in the base frame (N, 3); NaN where only a ray is known."""
        T = np.array([s.T_base_sensor.matrix for s in self.sensors]).reshape(-1, 4, 4)[self.sensor]
        points: FloatArray = np.einsum("nij,nj->ni", T[:, :3, :3], self.points_sensor) + T[:, :3, 3]
        return points

    def take(self, rows: npt.NDArray[np.int64] | BoolArray) -> Sightings:
        """Return some of them."""
        each = (field.name for field in fields(self) if field.name != "sensors")
        return replace(self, **{name: getattr(self, name)[rows] for name in each})


def make_sightings(  # columns
    sensors: tuple[Sensor, ...],
    *,
    sensor: IntArray,
    points_map: FloatArray,
    keypoints_px: FloatArray,
    points_sensor: FloatArray,
    sigmas_m: FloatArray,
) -> Sightings:
    """Return sightings with the rays of their keypoints."""
    rays = np.full((len(sensor), 3), np.nan)
    rad_per_px = np.full(len(sensor), np.nan)
    for number, each in enumerate(sensors):
        rows = np.flatnonzero(sensor == number)
        if each.calibration is None or not len(rows):
            continue
        px = keypoints_px[rows]
        beside = [px, px + np.array([1.0, 0.0]), px + np.array([0.0, 1.0])]
        rays[rows], right, below = np.split(unproject(each.calibration, np.concatenate(beside)), 3)
        turns = np.linalg.norm([right - rays[rows], below - rays[rows]], axis=2)
        rad_per_px[rows] = turns.mean(axis=0)
    return Sightings(
        sensors=sensors,
        sensor=sensor,
        points_map=points_map,
        keypoints_px=keypoints_px,
        points_sensor=points_sensor,
        sigmas_m=sigmas_m,
        rays=rays,
        rad_per_px=rad_per_px,
    )
