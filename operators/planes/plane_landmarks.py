"""Planes as landmarks: what several sensors see of them becomes measurements on the robot's poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.along_odometry import AlongOdometry, AlongOdometryOptions
from mapstream.operators.operator import DynamicPorts, Operator, Placement, Ports
from mapstream.operators.planes.known_planes import KnownPlanes, Reach
from mapstream.operators.planes.seen_plane import SeenPlane
from mapstream.recordings.maps.hulls import hull_payload
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from mapstream.streams.messages.planes import PlaneSegments


class PlaneLandmarksConfig(AlongOdometryOptions):
    """Options of `plane_landmarks`: inputs are `odometry`, those under `inputs`, and `corrections`."""

    inputs: tuple[str, ...] = ("planes",)
    """Names of the inputs that get planes, one for each sensor."""
    max_angle_deg: PositiveFloat = 10.0
    """Between a known plane and what is seen of it."""
    max_distance_m: PositiveFloat = 0.6
    """Of what is seen from the known plane."""
    at_once: float = Field(
        default=0.3,
        gt=0,
        le=1,
        description="share of both that counts a moment after a plane was seen",
    )
    full_after_m: PositiveFloat = 5.0
    """All of both counts after so much way without seeing the plane, for odometry drifts."""
    min_overlap: float = Field(
        default=0.1, ge=0, le=1, description="share of the smaller outline that lies on the other"
    )
    prefix: str = "plane"
    """Of the names of planes; robots whose maps become one have different ones, if they begin at one time."""
    is_switchable: bool = False
    """An optimizer may find that a measurement is false."""


@dataclass(frozen=True)
class Outputs:
    """One measurement for each plane seen, of kind `plane`; of each landmark, where it shows several to be one."""

    constraints: Sender[Constraint]


class PlaneLandmarks(DynamicPorts, Operator[Ports, Outputs]):
    """Recognise planes by where they are, and measure the robot's pose by them.

    Lines of a planar laser and planes of a depth camera or of clouds share landmarks. Where what is seen lies on two
    landmarks, it measures both, and after that all goes to the older one. Everything is decided by stamps: in their
    order, at poses between two messages of the odometry.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: PlaneLandmarksConfig) -> None:
        self._config = config
        reach = Reach(
            angle_rad=float(np.deg2rad(config.max_angle_deg)),
            distance_m=config.max_distance_m,
            min_overlap=config.min_overlap,
            at_once=config.at_once,
            full_after_m=config.full_after_m,
        )
        self.known = KnownPlanes(reach, config.prefix)
        self._along = AlongOdometry(
            config, self.known, self.measure, lost_m=config.full_after_m, what="planes"
        )

    @classmethod
    def ports_for(cls, config: PlaneLandmarksConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return config.ports(PlaneSegments), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        await self._along.run(inputs, outputs.constraints)

    def measure(
        self, planes: PlaneSegments, T_mission_base: FloatArray, path_m: float
    ) -> list[Constraint]:
        """Return a measurement of each plane that a sensor saw from a pose (4, 4), after so much way."""
        is_line = np.isinf(planes.covariances[:, 0, 0])
        poses = T_mission_base @ planes.T_base_plane
        pieces = [
            SeenPlane(pose, hull, bool(line))
            for pose, hull, line in zip(poses, planes.hulls_m, is_line, strict=True)
        ]
        names = self.known.see(planes.stamp_ns, pieces, T_mission_base, path_m)
        return [
            self._constraint(planes, row, name) for row, same in enumerate(names) for name in same
        ]

    def _constraint(self, planes: PlaneSegments, row: int, name: str) -> Constraint:
        return Constraint(
            stamp_ns=planes.stamp_ns,
            kind="plane",
            T_a_b=SE3(planes.T_base_plane[row]),
            covariance=planes.covariances[row],
            landmark=LandmarkRef(name=name, kind="plane"),
            payload=hull_payload(planes.hulls_m[row]),
            is_switchable=self._config.is_switchable,
            source=f"plane_landmarks {planes.frame}",
        )
