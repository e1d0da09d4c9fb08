"""Small maps of things whose truth is exact: a camera goes round them, and a detector draws boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.features import add_features
from mapstream.recordings.maps.ids import id_array, id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges, Vertices
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections

MISSION = "3c" * 16
CAMERA = CameraCalibration(
    frame="camera", width_px=640, height_px=480, focal_px=np.array([500.0, 500.0]),
    center_px=np.array([319.5, 239.5]), distortion_parameters=np.zeros(0),
)  # fmt: skip


@dataclass(frozen=True)
class Thing:
    """A box that stands upright."""

    label: str
    center: tuple[float, float, float]
    extent: tuple[float, float, float] = (0.3, 0.2, 0.25)
    yaw: float = 0.0

    @property
    def corners(self) -> FloatArray:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.placed(signs * np.array(self.extent) / 2)

    def placed(self, points: FloatArray) -> FloatArray:
        """Return points of its own frame (N, 3) in the world."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        placed: FloatArray = points @ R.T + np.array(self.center)
        return placed

    def seen_points(self, rng: np.random.Generator, eye: FloatArray, num: int) -> FloatArray:
        """Return points (num, 3) on the sides that an eye sees."""
        half = np.array(self.extent) / 2
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        local = (eye - np.array(self.center)) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        facing = [axis for axis in range(3) if abs(local[axis]) > half[axis]]
        areas = np.array([np.prod(2 * np.delete(half, axis)) for axis in facing])
        points = rng.uniform(-half, half, (num, 3))
        sides = rng.choice(facing, num, p=areas / areas.sum())
        points[np.arange(num), sides] = np.sign(local[sides]) * half[sides]
        return self.placed(points)


def looking(eye: FloatArray, target: FloatArray) -> FloatArray:
    """Return the pose (4, 4) of a camera that looks at a target."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye
    return T


def around(num: int, *, radius: float = 3.0, turn: float = 2 * np.pi, start: float = 0.0) -> FloatArray:  # fmt: skip
    """Return poses (num, 4, 4) on a part of a circle, looking at its middle from above."""
    angles = start + turn * np.arange(num) / num
    eyes = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(num, 1.5)])
    return np.array([looking(eye, np.array([0, 0, 0.3])) for eye in eyes])


def detections(
    T_world_camera: FloatArray,
    stamp_ns: int,
    things: list[Thing],
    tracks: list[int],
    *,
    noise_px: float = 0.0,
    num_points: int = 0,
    seed: int = 0,
) -> ObjectDetections:
    """Return the boxes around the things that an image shows, cut by its border, and points if wanted."""
    rng = np.random.default_rng((seed, stamp_ns))
    boxes, rows, points, centers = [], [], [], []
    size = np.array([CAMERA.width_px, CAMERA.height_px])
    R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
    for row, thing in enumerate(things):
        corners = (thing.corners - eye) @ R
        if (corners[:, 2] < 0.1).any():
            continue
        px = corners[:, :2] / corners[:, 2:] * CAMERA.focal_px + CAMERA.center_px
        box = np.concatenate([px.min(axis=0), px.max(axis=0)]) + rng.normal(0, noise_px, 4)
        box = np.clip(box, -0.5, np.tile(size, 2) - 0.5)
        if (box[2:] - box[:2] < 8).any():
            continue
        seen = (thing.seen_points(rng, eye, max(num_points, 1)) - eye) @ R
        boxes.append(box)
        rows.append(row)
        points.append(seen.astype(np.float32))
        centers.append(seen.mean(axis=0))
    found = ObjectDetections(
        stamp_ns=stamp_ns,
        frame="camera",
        width_px=640,
        height_px=480,
        boxes_px=_f4(boxes, 4),
        labels=tuple(things[row].label for row in rows),
        scores=np.full(len(rows), 0.9, np.float32),
        track_ids=np.array([tracks[row] for row in rows], np.int64),
        camera=CAMERA,
    )
    if not num_points:
        return found
    sigmas = np.full(len(rows), 0.05, np.float32)
    return replace(found, points_m=tuple(points), centers_m=_f4(centers, 3), center_sigmas_m=sigmas)


def map_of(poses: FloatArray, seen: list[ObjectDetections]) -> Map:
    """Return a map with a vertex for each pose, and what was detected there."""
    stamps_ns = np.array([each.stamp_ns for each in seen])
    vertices = Vertices(
        id=id_array(vertex_id(id_bytes(MISSION), s) for s in stamps_ns.tolist()),
        mission=np.zeros(len(seen), np.int64),
        stamp_ns=stamps_ns,
        T_mission_base=poses,
    )
    map_ = replace(new_mission(Map.empty(), MISSION), vertices=vertices)
    first = np.arange(len(seen) - 1)
    links = Edges(kind=np.array(["odometry"] * len(first), object), vertex_a=first, vertex_b=first + 1)  # fmt: skip
    features = ObjectFeatures(ObjectFeaturesConfig())
    return add_features(
        append_edges(map_, links), 0, [(n, d.stamp_ns, features.features(d)) for n, d in enumerate(seen)]
    )  # fmt: skip


def positions(map_: Map) -> FloatArray:
    """Return where the landmarks of a map are (L, 3)."""
    return map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]


def T_camera(poses: FloatArray, row: int) -> SE3:
    return SE3(poses[row])


def _f4(rows: list[FloatArray], width: int) -> Float32Array:
    return np.array(rows, np.float32).reshape(-1, width)
