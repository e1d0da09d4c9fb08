"""Planes in clouds without order, as an operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.lidar.sampling import usable
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload
from mapstream.operators.period import Period
from mapstream.operators.planes.oriented_points import oriented_points
from mapstream.operators.planes.ransac import CloudPlane, RansacLimits, cloud_planes
from mapstream.recordings.maps.hulls import convex_hull
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.sync import merge


class CloudPlanesConfig(OperatorConfig):
    """Options of `cloud_planes`."""

    period_s: NonNegativeFloat = 0.0
    """The first cloud in each stretch of so long is looked at; 0: all are."""
    min_range_m: NonNegativeFloat = 0.5
    max_range_m: PositiveFloat = 30.0
    """Farther points are too few to tell a plane."""
    voxel_size_m: PositiveFloat = 0.2
    """One point in each counts."""
    max_distance_m: PositiveFloat = 0.08
    """Of points from their plane."""
    max_angle_deg: PositiveFloat = 15.0
    """Of their normals from that of the plane."""
    max_gap_m: PositiveFloat = 0.6
    """Between points of one piece of a plane."""
    min_points: PositiveInt = 60
    min_area_m2: NonNegativeFloat = 1.5
    """Of a plane's outline."""
    max_planes: PositiveInt = 12
    num_samples: PositiveInt = 96
    """Tried for each plane."""
    seed: NonNegativeInt = 0
    sigma_point_m: PositiveFloat = 0.02
    """Of points off their plane, if they do not lie further off."""
    sigma_rad: NonNegativeFloat = 0.003
    """Of a normal, beyond what its points make of it."""
    sigma_m: NonNegativeFloat = 0.005
    """The same of a plane's place."""


@dataclass(frozen=True)
class Inputs:
    """Clouds without motion distortion, or scans as they come, of sensors that hardly move meanwhile."""

    clouds: Receiver[PointCloud] | None = None
    scans: Receiver[LidarScan] | None = None


@dataclass(frozen=True)
class Outputs:
    """The planes of every cloud."""

    planes: Sender[PlaneSegments]


class CloudPlanes(Operator[Inputs, Outputs]):
    """Find planes by random samples and by what hangs together; the same cloud gives the same planes."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: CloudPlanesConfig) -> None:
        self._config = config
        self._period = Period(config.period_s)
        self._limits = RansacLimits(
            distance_m=config.max_distance_m,
            angle_rad=float(np.deg2rad(config.max_angle_deg)),
            gap_m=config.max_gap_m,
            min_points=config.min_points,
            min_area_m2=config.min_area_m2,
            max_planes=config.max_planes,
            num_samples=config.num_samples,
        )

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        connected = [each for each in (inputs.clouds, inputs.scans) if each is not None]
        if not connected:
            raise OperatorError("cloud_planes: connect clouds or scans")
        async for _, seen in merge(*connected):
            if self._period.begins(seen.stamp_ns):
                await outputs.planes.send(await offload(self.find, seen))
            else:
                outputs.planes.advance(seen.stamp_ns)

    def find(self, seen: PointCloud | LidarScan) -> PlaneSegments:
        """Return the planes of a cloud, whose points the base sees, or of a scan."""
        if isinstance(seen, PointCloud):
            return self._segments(seen.stamp_ns, seen.points, SE3.identity(), "cloud")
        return self._segments(seen.stamp_ns, seen.points, seen.T_base_sensor, seen.frame)

    def _segments(
        self, stamp_ns: int, points: npt.NDArray[np.floating], T_base_sensor: SE3, frame: str
    ) -> PlaneSegments:
        config = self._config
        points = points[usable(points, config.min_range_m, config.max_range_m)]
        cloud = oriented_points(
            points, np.zeros(3), voxel_size_m=config.voxel_size_m, radius_m=4 * config.voxel_size_m
        )
        planes = cloud_planes(cloud, self._limits, np.random.default_rng((config.seed, stamp_ns)))
        T = T_base_sensor.matrix
        return PlaneSegments(
            stamp_ns=stamp_ns,
            T_base_plane=np.array([T @ plane.T_frame_plane for plane in planes]).reshape(-1, 4, 4),
            covariances=np.array([self._covariance(p) for p in planes]).reshape(-1, 6, 6),
            hulls_m=tuple(convex_hull(plane.points[:, :2]) for plane in planes),
            num_points=np.array([len(plane.points) for plane in planes], dtype=np.int64),
            rmse_m=np.array([_rmse_m(plane) for plane in planes]),
            frame=frame,
            T_base_sensor=T_base_sensor,
        )

    def _covariance(self, plane: CloudPlane) -> FloatArray:
        """Return what the points say of turns about x and y and of the shift along z."""
        x, y = plane.points[:, 0], plane.points[:, 1]
        by_motion = np.column_stack([y, -x, np.ones(len(x))])
        sigma_m = max(self._config.sigma_point_m, _rmse_m(plane))
        covariance = np.diag(np.full(6, np.inf))
        measured = sigma_m**2 * np.linalg.inv(by_motion.T @ by_motion)
        floor = [self._config.sigma_rad, self._config.sigma_rad, self._config.sigma_m]
        covariance[np.ix_([0, 1, 5], [0, 1, 5])] = measured + np.diag(np.square(floor))
        return covariance


def _rmse_m(plane: CloudPlane) -> float:
    return float(np.sqrt(np.mean(plane.points[:, 2] ** 2)))
