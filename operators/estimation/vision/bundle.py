"""The bundle behind a map: who saw which points, with which sensors, and where all of them are.

Landmarks of good or unknown quality take part, if rays from two places or a 3D point determine them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.optimize_config import Loss, OptimizeConfig
from mapstream.operators.estimation.vision.schur import Pairs
from mapstream.operators.estimation.vision.sightings import Family, SensorState, Sightings
from mapstream.operators.landmarks.motion import Motion, moments
from mapstream.operators.landmarks.sensors import T_base_sensor_of, all_cameras, sensors_of
from mapstream.operators.landmarks.views import capture_offsets_ns, point_sigmas_m
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.geometry import se3_exp

FAMILIES: tuple[Family, ...] = ("keypoints", "points")
_USUAL_LOSS: Loss = "huber"
_USUAL_WIDTH = 3.0  # standard deviations (maplab)
_MIN_PARALLAX_RAD = 1e-3  # below it depth is hardly more than a guess


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """One sensor of a mission, and the keys of what shall be refined of it."""

    mission: int
    name: str
    state: SensorState
    mount_key: int | None = None
    intrinsics_key: int | None = None
    time_offset_key: int | None = None

    @property
    def keys(self) -> list[int]:
        keys = (self.mount_key, self.intrinsics_key, self.time_offset_key)
        return [key for key in keys if key is not None]


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Observations that take part in a problem."""

    vertices: IntArray  # (V,) rows; the poses of the pairs count these
    landmarks: IntArray  # (L,) rows; the points of the pairs count these
    pairs: Pairs
    sensors: tuple[Sensor, ...]
    sightings: tuple[Sightings, ...]
    motion: Motion | None  # in the map frame; None if all saw at the times of their vertices
    offsets_ns: Mapping[
        int, IntArray
    ]  # by number of the sightings, of those with times of their own
    points_stay: bool = False  # where they are

    @property
    def keys(self) -> list[int]:
        """The variables that the bundle is on."""
        of_sensors = (key for sensor in self.sensors for key in sensor.keys)
        return [*self.vertices.tolist(), *self.point_keys, *of_sensors]

    @property
    def point_keys(self) -> list[int]:
        return [key_of("landmark", row) for row in self.landmarks.tolist()]

    def __len__(self) -> int:
        """Return how many points are in it."""
        return len(self.landmarks)

    @property
    def num_residuals(self) -> int:
        return sum(seen.measured.size for seen in self.sightings)

    @property
    def links(self) -> IntArray:
        """Rows of vertices (N, 2) that saw one point."""
        pairs, rows = self.pairs, self.vertices[self.pairs.pose]
        same = pairs.point[1:] == pairs.point[:-1]
        return np.stack([rows[:-1][same], rows[1:][same]], axis=1)

    def moved(self, motion: Motion, late_s: list[float]) -> Bundle:
        """Return the bundle with the base at the times of the observations, as it moves now."""
        if not self.offsets_ns:
            return self
        changed = list(self.sightings)
        for number, offsets_ns in self.offsets_ns.items():
            seen = changed[number]
            late_ns = round(late_s[seen.sensor] * 1e9)
            vertices = self.vertices[self.pairs.pose[seen.pair]]
            there = moments(motion, vertices, offsets_ns + late_ns)
            if late_ns:  # the state moves it there again
                there = replace(there, T_vertex_moment=there.T_vertex_moment @ se3_exp(-late_s[seen.sensor] * there.twists))  # fmt: skip
            changed[number] = replace(seen, moments=there)
        return replace(self, sightings=tuple(changed))


def make_bundle(map_: Map, config: OptimizeConfig) -> Bundle:
    """Return what the observations of a map say; it is empty where none takes part."""
    rows, families = _taking_part(map_, config)
    seen = map_.observations
    landmarks, point = np.unique(seen.landmark[rows], return_inverse=True)
    vertices, pose = np.unique(seen.vertex[rows], return_inverse=True)
    num = max(len(vertices), 1)
    codes, pair = np.unique(point * num + pose, return_inverse=True)
    pairs = Pairs(codes % num, codes // num, len(vertices))
    names, at = sensors_of(map_, rows)
    sensors = _sensors(map_, names, rows, at, config)
    offsets_ns = capture_offsets_ns(map_, rows)
    sightings: list[Sightings] = []
    timed: dict[int, IntArray] = {}
    for number, sensor in enumerate(sensors):
        for family in FAMILIES:
            own = np.flatnonzero((at == number) & families[family])
            if not len(own):
                continue
            if offsets_ns[own].any() or sensor.time_offset_key is not None:
                timed[len(sightings)] = offsets_ns[own]
            sightings.append(_sightings(map_, family, number, rows[own], pair[own], config))
    bundle = Bundle(
        vertices, landmarks, pairs, tuple(sensors), tuple(sightings),
        motion_in_map(map_) if timed else None, timed, "landmarks" in config.fix,
    )  # fmt: skip
    return bundle.moved(bundle.motion, [0.0] * len(sensors)) if bundle.motion else bundle


def motion_in_map(map_: Map) -> Motion:
    """Return the motion of all missions in the map frame."""
    motion = Motion.of(map_)
    frames = map_.missions.T_map_mission[map_.vertices.mission, :3, :3]
    return replace(
        motion,
        poses=map_.T_map_base(np.arange(len(map_.vertices))),
        velocities=np.einsum("nij,nj->ni", frames, motion.velocities),
    )


def _taking_part(map_: Map, config: OptimizeConfig) -> tuple[IntArray, dict[Family, BoolArray]]:
    """Return the observations that take part, and which of them are of each family."""
    seen = map_.observations
    quality = np.append(map_.landmarks.quality, "bad")
    is_on = {f: f not in config.without and (config.kinds is None or f in config.kinds) for f in FAMILIES}  # fmt: skip
    is_point_like = np.array([shape_of(kind) == "point" for kind in map_.landmarks.kind], bool)
    takes_part = (quality[seen.landmark] != "bad") & np.append(is_point_like, False)[seen.landmark]
    if config.unanchored == "apart":
        takes_part &= ~_leaves_the_known(map_)
    rows = np.flatnonzero(takes_part)
    names, at = sensors_of(map_, rows)
    cameras = all_cameras(map_)
    has_camera = np.array([name in cameras for name in names], bool)[at]
    has_pixel = np.isfinite(seen.keypoint_px[rows]).all(axis=1) & has_camera
    has_point = np.isfinite(seen.p_sensor[rows]).all(axis=1)
    families: dict[Family, BoolArray] = {
        "keypoints": np.asarray(has_pixel & is_on["keypoints"]),
        "points": np.asarray(has_point & is_on["points"]),
    }
    is_determined = _determined(map_, rows, families)
    keep = (families["keypoints"] | families["points"]) & is_determined[seen.landmark[rows]]
    return rows[keep], {f: mask[keep] for f, mask in families.items()}


def _leaves_the_known(map_: Map) -> BoolArray:
    """Return which observations (N,) are of a landmark of a mission whose place is known, and their own is not, or the reverse."""
    seen, is_known = map_.observations, map_.missions.is_base_frame_known
    at_home = is_known[map_.vertices.mission[map_.landmarks.vertex]]
    leaves: BoolArray = is_known[map_.vertices.mission[seen.vertex]] != np.append(at_home, False)[seen.landmark]  # fmt: skip
    return leaves & (seen.landmark >= 0)


def _determined(map_: Map, rows: IntArray, families: dict[Family, BoolArray]) -> BoolArray:
    """Return which landmarks (L,) have a 3D point, or rays from more than one place."""
    seen, num = map_.observations, len(map_.landmarks)
    determined = np.zeros(num, bool)
    determined[seen.landmark[rows[families["points"]]]] = True
    rays = rows[families["keypoints"]]
    landmark = seen.landmark[rays]
    if not len(rays):
        return determined
    T_map_sensor = map_.T_map_base(seen.vertex[rays]) @ T_base_sensor_of(map_, rays)
    p_map = map_.T_map_landmark(np.arange(num))[:, :3, 3]
    away = p_map[landmark] - T_map_sensor[:, :3, 3]
    toward = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    spread = np.zeros(num)
    low, high = np.full((num, 3), np.inf), np.full((num, 3), -np.inf)
    np.minimum.at(low, landmark, toward)
    np.maximum.at(high, landmark, toward)
    is_seen = np.isfinite(low).all(axis=1)
    spread[is_seen] = np.linalg.norm(high[is_seen] - low[is_seen], axis=1)
    return determined | (spread > _MIN_PARALLAX_RAD)


def _sensors(
    map_: Map, names: list[tuple[int, str]], rows: IntArray, at: IntArray, config: OptimizeConfig
) -> list[Sensor]:
    cameras = all_cameras(map_)
    number_of = {name: number for number, name in enumerate(cameras)}
    first = rows[np.unique(at, return_index=True)[1]]
    places = T_base_sensor_of(map_, first)
    made = []
    for (mission, name), place in zip(names, places, strict=True):
        camera = cameras.get((mission, name))
        state = SensorState(place, camera.calibration if camera else None)
        keys: dict[str, int] = {}
        if camera is not None and name in (config.refined_cameras or (name,)):
            number = number_of[mission, name]
            if "extrinsics" in config.refine:
                keys["mount_key"] = key_of("camera", number)
            if "intrinsics" in config.refine:
                keys["intrinsics_key"] = key_of("intrinsics", number)
            if "time_offset" in config.refine:
                keys["time_offset_key"] = key_of("time_offset", number)
        made.append(Sensor(mission, name, state, **keys))
    return made


def _sightings(
    map_: Map, family: Family, sensor: int, rows: IntArray, pair: IntArray, config: OptimizeConfig
) -> Sightings:
    seen = map_.observations
    is_px = family == "keypoints"
    measured = seen.keypoint_px[rows] if is_px else seen.p_sensor[rows]
    sigmas = seen.sigma[rows].astype(np.float64) if is_px else point_sigmas_m(map_, rows)
    loss = config.losses.get(family, _USUAL_LOSS)
    gate = config.max_reprojection_error_px / sigmas if is_px else np.full(len(rows), np.inf)
    return Sightings(
        family=family,
        sensor=sensor,
        rows=rows,
        pair=pair,
        measured=measured.astype(np.float64),
        sigmas=sigmas,
        loss=None if loss == "squared" else loss,
        loss_width=_USUAL_WIDTH * config.loss_width,
        gate=gate,
    )
