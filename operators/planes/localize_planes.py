"""Where a robot is in a map of planes that was made before, by planes alone and the odometry between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.period import Period
from mapstream.operators.places.drift import Drift, DriftConfig, Fix
from mapstream.operators.places.map_poses import MapPoses, send_pose
from mapstream.operators.planes.known_planes import KnownPlanes, Reach
from mapstream.operators.planes.plane_evidence import KnownOutlines, samples_of
from mapstream.operators.planes.plane_pose import PlaneNoise, pose_covariance, pose_from_planes
from mapstream.operators.planes.plane_search import (
    SearchLimits,
    matches,
    plane_set,
    search,
)
from mapstream.operators.planes.seen_plane import SeenPlane
from mapstream.operators.planes.whereabouts import Whereabouts
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.hulls import hull_of
from mapstream.streams.arrays import IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.sync import merge

_OPEN = 10.0  # rad, m: of directions that the planes of one moment leave open
_IN_DOUBT = 3  # moments one after another that contradict the pose: then the robot is lost


class LocalizePlanesConfig(OperatorConfig):
    """Options of `localize_planes`."""

    map: Path
    """The folder of a map with planes."""
    period_s: NonNegativeFloat = 0.5
    """Between two moments whose planes are compared with the map; 0: all are."""
    memory_s: PositiveFloat = 4.0
    """What was seen so long ago still helps a robot that is lost."""
    max_angle_deg: PositiveFloat = 8.0
    """Between a plane and a known one."""
    max_distance_m: PositiveFloat = 0.2
    min_planes: PositiveInt = 4
    """For a robot that is lost."""
    min_score: float = Field(
        default=0.6, gt=0, le=1, description="share of what a lost robot sees that lies on the map"
    )
    lead: float = Field(
        default=1.15, ge=1, description="of the best place over the second one, by that share"
    )
    sigma_rad: PositiveFloat = 0.01
    """Of a plane against a known one."""
    sigma_m: PositiveFloat = 0.02
    seed: NonNegativeInt = 0
    drift: DriftConfig = Field(default_factory=DriftConfig)


@dataclass(frozen=True)
class Inputs:
    """What is seen of planes, and how the robot moves between."""

    planes: Receiver[PlaneSegments]
    odometry: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    """One pose for each odometry."""

    poses: Sender[MapPose]
    odometry: Sender[Odometry]  # the poses in the map alone, where the robot is not lost


class LocalizePlanes(Operator[Inputs, Outputs]):
    """Recognise the planes of a map, and hold the odometry there; the map does not grow.

    A robot that is lost searches with all it saw in the last seconds, and is found when some searches agree. One
    that is not lays the planes of each moment on those it should see; what these leave open the odometry holds.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LocalizePlanesConfig) -> None:
        self._config = config
        self._limits = SearchLimits(
            angle_rad=float(np.deg2rad(config.max_angle_deg)),
            distance_m=config.max_distance_m,
            min_planes=config.min_planes,
            min_score=config.min_score,
            lead=config.lead,
            noise=PlaneNoise(sigma_rad=config.sigma_rad, sigma_m=config.sigma_m),
        )
        self._drift = Drift(config.drift)
        self._period = Period(config.period_s)
        self._map: list[SeenPlane] | None = None
        self._where = Whereabouts(lost_m=0.0)
        self._recent = KnownPlanes(_reach(config), "recent")
        self._waiting: list[PlaneSegments] = []
        self._poses = MapPoses()
        self._num_doubts = 0

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await offload(self._known)
        async for _, message in merge(inputs.planes, inputs.odometry):
            if isinstance(message, PlaneSegments):
                if self._period.begins(message.stamp_ns):
                    self._waiting.append(message)
                continue
            pose = await offload(self.follow, message)
            await send_pose(pose, outputs.poses, outputs.odometry)
        if not self._poses.has_tracked:
            warn("the robot was never found in the map")

    def follow(self, odometry: Odometry) -> MapPose:
        """Return where the robot is at this moment of its odometry, after the planes until then."""
        self._where.follow(odometry)
        self._drift.move(odometry.T_odom_base)
        num_planes, verdict = 0, ""
        for planes in self._waiting:
            num_planes, verdict = self._locate(planes)
        self._waiting.clear()
        T_map_odom = self._drift.T_map_odom(odometry.stamp_ns)
        moment = odometry.stamp_ns, odometry.T_odom_base
        return self._poses.next(moment, T_map_odom, self._drift.covariance, num_planes, verdict)

    def _locate(self, planes: PlaneSegments) -> tuple[int, str]:
        """Correct the pose by what was seen at one moment; return how many planes agree, and what came of it."""
        T_odom_base = self._where.note(planes.stamp_ns)
        if T_odom_base is None:
            return 0, "no odometry at this time"
        T = SE3(T_odom_base)
        pieces = [
            SeenPlane(T.matrix @ pose, hull)
            for pose, hull in zip(planes.T_base_plane, planes.hulls_m, strict=True)
            if len(hull) >= 3
        ]
        T_map_odom = self._drift.T_map_odom(planes.stamp_ns)
        found = 0
        if T_map_odom is not None and pieces:
            found = self._track(planes, pieces, T, T_map_odom)
            self._num_doubts = 0 if found else self._num_doubts + 1
            if self._num_doubts == 1:  # what was seen before may be of another place
                self._recent = KnownPlanes(_reach(self._config), "recent")
            elif self._num_doubts == _IN_DOUBT:
                self._drift = Drift(self._config.drift)
                self._drift.move(T)
        self._recent.see(planes.stamp_ns, pieces, T.matrix, self._where.path_m)
        return (found, "accepted") if found else self._search(planes.stamp_ns, T)

    def _track(
        self,
        planes: PlaneSegments,
        pieces: Sequence[SeenPlane],
        T_odom_base: SE3,
        T_map_odom: SE3,
    ) -> int:
        """Lay what is seen on what should be; return how many planes did, 0 if they contradict the map there."""
        known, seen = self._known(), _moved(pieces, T_odom_base.inverse())
        T_map_base, limits = T_map_odom @ T_odom_base, self._limits
        samples = samples_of(seen, np.tile(planes.T_base_sensor.t, (len(seen), 1)))
        (score,) = KnownOutlines(known).scores(
            samples,
            T_map_base.matrix[None],
            angle_rad=limits.angle_rad,
            distance_m=limits.distance_m,
        )
        pairs = matches(known, seen, T_map_base, limits)
        if score < limits.min_score or not len(pairs):
            return 0
        self._correct(planes.stamp_ns, known, seen, pairs, T_map_base, T_odom_base)
        return len(pairs)

    def _search(self, stamp_ns: int, T_odom_base: SE3) -> tuple[int, str]:
        oldest_ns = stamp_ns - round(self._config.memory_s * 1e9)
        recent = [each for each in self._recent.planes if each.seen_ns >= oldest_ns]
        T_base_odom = T_odom_base.inverse()
        seen = _moved([each.plane for each in recent], T_base_odom)
        origins = [
            (T_base_odom.matrix @ each.plane.T_frame_plane @ invert(each.T_base_plane))[:3, 3]
            for each in recent
        ]
        result = search(
            self._known(),
            seen,
            np.array(origins).reshape(-1, 3),
            self._limits,
            self._config.seed + stamp_ns % 2**32,
        )
        if result.place is None:
            return 0, result.reason
        place = result.place
        self._correct(stamp_ns, self._known(), seen, place.pairs, place.T_map_seen, T_odom_base)
        return len(place.pairs), result.reason

    def _correct(
        self,
        stamp_ns: int,
        known: Sequence[SeenPlane],
        seen: Sequence[SeenPlane],
        pairs: IntArray,
        T_map_base: SE3,
        T_odom_base: SE3,
    ) -> None:
        map_set, seen_set = plane_set(known), plane_set(seen)
        T, information = pose_from_planes(
            map_set.chosen(pairs[:, 1]),
            seen_set.chosen(pairs[:, 0]),
            T_map_base,
            self._limits.noise,
        )
        self._drift.correct(Fix(stamp_ns, T, pose_covariance(information, _OPEN), T_odom_base))

    def _known(self) -> list[SeenPlane]:
        if self._map is None:
            self._map = planes_of(load_map(self._config.map))
        return self._map


def planes_of(map_: Map) -> list[SeenPlane]:
    """Return the planes of a map, in its frame.

    Raises:
        MapError: If it has none with an outline.
    """
    rows = np.flatnonzero(map_.landmarks.kind == "plane")
    hulls = [hull_of(map_.landmarks.payload[row]) for row in rows]
    planes = [
        SeenPlane(T, hull)
        for T, hull in zip(map_.T_map_landmark(rows), hulls, strict=True)
        if len(hull) >= 3
    ]
    if not planes:
        raise MapError("the map has no planes with outlines; make one with plane_landmarks")
    return planes


def _moved(planes: Sequence[SeenPlane], T: SE3) -> list[SeenPlane]:
    return [SeenPlane(T.matrix @ plane.T_frame_plane, plane.hull_m) for plane in planes]


def _reach(config: LocalizePlanesConfig) -> Reach:
    return Reach(
        angle_rad=float(np.deg2rad(config.max_angle_deg)),
        distance_m=config.max_distance_m,
        min_overlap=0.1,
        at_once=0.5,
        full_after_m=5.0,
    )
