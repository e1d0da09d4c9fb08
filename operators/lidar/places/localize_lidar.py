"""Where a robot with a LiDAR is in a map that was made before, while it drives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat

from mapstream.operators.lidar.places.map_clouds import Located, MapClouds, MapCloudsConfig
from mapstream.operators.lidar.places.place_matcher import ACCEPTED
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.operators.period import Spacing
from mapstream.operators.places.drift import DriftConfig
from mapstream.operators.places.following import Following
from mapstream.operators.places.map_poses import send_pose
from mapstream.recordings.maps import load_map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import MapPose, Odometry, PointCloud
from mapstream.streams.sync import merge


class LocalizeLidarConfig(MapCloudsConfig):
    """Options of `localize_lidar`."""

    map: Path
    """The folder of the map, with its clouds."""
    period_s: NonNegativeFloat = 0.5
    """Between two clouds that are compared with the map; 0: all are."""
    late_s: NonNegativeFloat = 0.2
    """So long after its stamp a cloud corrects the pose."""
    drift: DriftConfig = Field(default_factory=DriftConfig)


@dataclass(frozen=True)
class Inputs:
    """Clouds without motion distortion, in the base frame, and how the robot moves between."""

    clouds: Receiver[PointCloud]
    odometry: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    """One pose for each odometry."""

    poses: Sender[MapPose]
    odometry: Sender[Odometry]  # the poses in the map alone, where the robot is not lost


class LocalizeLidar(Operator[Inputs, Outputs]):
    """Find a LiDAR in a map, hold its odometry there, and find it again when it was carried elsewhere.

    While the robot is known, clouds are registered to the map's clouds around it. A robot that is lost, or whose
    cloud does not fit where it is taken to be, is looked for by what the place looks like. Some clouds must agree
    before that is believed. `recovered` is the first pose after being lost. The map does not grow.
    """

    placement: ClassVar[Placement] = "process"  # small_gicp holds the GIL

    def __init__(self, config: LocalizeLidarConfig) -> None:
        self._config = config
        self._late_ns = round(config.late_s * 1e9)
        self._following = Following(config.drift, self._late_ns)
        self._map: MapClouds | None = None
        self._spacing = Spacing(config.period_s)
        self._waiting: list[PointCloud] = []  # for the odometry of their time

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        self._map = await offload(self._opened)
        async for _, message in merge(inputs.odometry, inputs.clouds, delays_ns=(0, self._late_ns)):
            if isinstance(message, Odometry):
                pose = await offload(self.follow, message)
                await send_pose(pose, outputs.poses, outputs.odometry)
            elif self._spacing.allows(message.stamp_ns):
                self._waiting.append(message)
        if not self._following.has_tracked:
            warn("the robot was never found in the map")

    def _opened(self) -> MapClouds:
        return MapClouds(load_map(self._config.map), self._config.map, self._config)

    def follow(self, odometry: Odometry) -> MapPose:
        """Return where the robot is at this moment of its odometry, after the clouds until then."""
        self._following.move(odometry)
        num_inliers, verdict = 0, ""
        for cloud in self._waiting:
            found = self._locate(cloud)
            num_inliers, verdict = found.num_inliers, found.verdict
            if found.T_map_base is not None and found.covariance is not None:
                self._following.correct(cloud.stamp_ns, found.T_map_base, found.covariance)
        self._waiting.clear()
        return self._following.pose(num_inliers, verdict)

    def _locate(self, cloud: PointCloud) -> Located:
        """Return where a cloud was taken: near where the robot is taken to be, or anywhere."""
        self._map = places = self._map or self._opened()
        points = cloud.points.astype(np.float64)
        T_map_base = self._following.T_map_base_at(cloud.stamp_ns)
        if T_map_base is not None:
            near = places.near(points, T_map_base)
            if near.verdict == ACCEPTED:
                return near
        return places.anywhere(points)
