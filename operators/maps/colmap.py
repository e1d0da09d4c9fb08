"""Maps to COLMAP's models and back: every camera at every vertex is an image."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapstream.operators.maps.trajectory_map import ImportConfig, trajectory_map
from mapstream.recordings.colmap import ColmapImage, ColmapModel, has_model, read_model
from mapstream.recordings.maps.cameras import Camera, cameras_of, with_cameras
from mapstream.recordings.maps.features import KEYPOINT_SIGMA_PX
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Landmarks, Observations
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.trajectory import Trajectory

_KIND = "colmap"  # of landmarks that come from a model
_STAMP = re.compile(r"(\d+)(?:\.\w+)?$")


def colmap_model(map_: Map) -> tuple[ColmapModel, Counter[str]]:
    """Return a map's cameras, images and visual landmarks as a model, and what has no place there."""
    left_out: Counter[str] = Counter()
    model = ColmapModel()
    seen = map_.observations
    known = {m: cameras_of(map_, m) for m in range(len(map_.missions))}
    numbers: dict[tuple[int, str], int] = {}
    for mission, cameras in known.items():
        for name, camera in cameras.items():
            if has_model(camera.calibration):
                numbers[mission, name] = len(numbers) + 1
                model.cameras[numbers[mission, name]] = camera.calibration
    is_pixel = np.isfinite(seen.keypoint_px).all(axis=1)
    used = np.zeros(len(map_.landmarks), bool)
    for rows in _images(map_, np.flatnonzero(is_pixel)):
        vertex, sensor = int(seen.vertex[rows[0]]), str(seen.sensor[rows[0]])
        mission = int(map_.vertices.mission[vertex])
        if (mission, sensor) not in numbers:
            left_out[f"images of {sensor}"] += 1
            continue
        T_map_base = SE3(map_.T_map_base(np.array([vertex]))[0])
        T_map_camera = T_map_base @ known[mission][sensor].T_base_sensor
        stamp_ns = int(map_.vertices.stamp_ns[vertex])
        prefix = f"{map_.mission_id(mission)[:8]}/" if len(known) > 1 else ""
        points = np.where(seen.landmark[rows] >= 0, seen.landmark[rows] + 1, -1)
        used[seen.landmark[rows][points > 0]] = True
        model.images[len(model.images) + 1] = ColmapImage(
            name=f"{prefix}{sensor}/{stamp_ns}.png",
            camera=numbers[mission, sensor],
            T_camera_world=T_map_camera.inverse(),
            keypoints_px=seen.keypoint_px[rows].astype(np.float64),
            points=points,
        )
    rows = np.flatnonzero(used)
    for row, pose in zip(rows.tolist(), map_.T_map_landmark(rows), strict=True):
        model.points[row + 1] = pose[:3, 3]
    return model, left_out


def _images(map_: Map, rows: IntArray) -> list[IntArray]:
    """Return the observations of each image: of a vertex, by a sensor."""
    sensors, sensor = np.unique(map_.observations.sensor[rows].astype(str), return_inverse=True)
    image = map_.observations.vertex[rows] * max(len(sensors), 1) + sensor
    order = np.argsort(image, kind="stable")
    starts = np.flatnonzero(np.diff(image[order])) + 1
    return [each for each in np.split(rows[order], starts) if len(each)]


def colmap_map(folder: Path, config: ImportConfig) -> Map:
    """Return a model as a map of one mission; images that were taken together share a vertex.

    A name that ends with a number is of that stamp [ns]; where one does not, images are numbered.
    The base is the first camera by name; consecutive vertices are joined by odometry, as good as a trajectory's.

    Raises:
        RecordingError: If the model is not understood or has no images.
    """
    model = read_model(folder)
    if not model.images:
        raise RecordingError(f"{folder}: a model without images")
    stamps = _stamps(model.images)
    sensors = {number: _sensor(image) for number, image in model.images.items()}
    places = _mounts(model, stamps, sensors)
    poses: dict[int, FloatArray] = {}
    for number, image in sorted(model.images.items(), key=lambda each: sensors[each[0]]):
        T_world_camera = image.T_camera_world.inverse()
        T_world_base = T_world_camera @ places[sensors[number]].inverse()
        poses.setdefault(stamps[number], T_world_base.matrix)
    order = sorted(poses)
    trajectory = Trajectory(
        stamps_ns=np.array(order), poses=np.array([poses[stamp] for stamp in order])
    )
    map_ = trajectory_map(trajectory, folder.name, config)
    cameras = {
        sensors[number]: Camera(
            calibration=replace(model.cameras[image.camera], frame=sensors[number]),
            T_base_sensor=places[sensors[number]],
        )
        for number, image in model.images.items()
    }
    map_ = with_cameras(map_, 0, cameras)
    row_of = {stamp: row for row, stamp in enumerate(order)}
    return _with_points(map_, model, {n: row_of[s] for n, s in stamps.items()}, sensors)


def _stamps(images: Mapping[int, ColmapImage]) -> dict[int, int]:
    """Return the stamp of each image [ns]."""
    found = {number: _STAMP.search(image.name) for number, image in images.items()}
    if all(found.values()):
        stamps = {number: int(match[1]) for number, match in found.items() if match}
        folders = {number: image.name.rpartition("/")[0] for number, image in images.items()}
        if len({(folders[n], stamps[n]) for n in images}) == len(images):
            return stamps
    return {number: at for at, number in enumerate(sorted(images))}


def _sensor(image: ColmapImage) -> str:
    folder = image.name.rpartition("/")[0]
    return folder or f"camera{image.camera}"


def _mounts(
    model: ColmapModel, stamps: Mapping[int, int], sensors: Mapping[int, str]
) -> dict[str, SE3]:
    """Return T_base_sensor by camera: the first camera by name is the base, others as seen beside it."""
    base = min(sensors.values())
    T_base_world = {
        stamps[n]: i.T_camera_world for n, i in model.images.items() if sensors[n] == base
    }
    places = {base: SE3.identity()}
    for number, image in model.images.items():
        beside = T_base_world.get(stamps[number])
        if beside is not None:
            places.setdefault(sensors[number], beside @ image.T_camera_world.inverse())
    for name in set(sensors.values()) - places.keys():
        places[name] = SE3.identity()
    return places


def _with_points(
    map_: Map, model: ColmapModel, vertex_of: Mapping[int, int], sensors: Mapping[int, str]
) -> Map:
    """Return the map with the points that images see as landmarks, each at its first observer."""
    first: dict[int, int] = {}
    for number, image in sorted(model.images.items(), key=lambda each: vertex_of[each[0]]):
        for point in image.points[image.points >= 0].tolist():
            first.setdefault(point, vertex_of[number])
    rows = {point: row for row, point in enumerate(sorted(first))}
    homes = np.array([first[point] for point in rows], dtype=np.int64)
    p_world = np.array([model.points[point] for point in rows]).reshape(-1, 3, 1)
    T_base_world = invert(map_.T_map_base(homes))
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", map_.mission_id(0), str(point)) for point in rows),
        kind=np.full(len(rows), _KIND, dtype=object),
        vertex=homes,
        p_base=(T_base_world[:, :3, :3] @ p_world)[..., 0] + T_base_world[:, :3, 3],
    )
    images = list(model.images.items())
    counts = [len(image.points) for _, image in images]
    points = np.concatenate([image.points for _, image in images])
    observations = Observations(
        vertex=np.repeat([vertex_of[number] for number, _ in images], counts),
        landmark=np.array([rows.get(point, -1) for point in points.tolist()], dtype=np.int64),
        track=points,
        kind=np.full(len(points), _KIND, dtype=object),
        sensor=np.repeat(np.array([sensors[n] for n, _ in images], dtype=object), counts),
        keypoint_px=np.concatenate([image.keypoints_px for _, image in images]),
        sigma=np.full(len(points), KEYPOINT_SIGMA_PX, np.float32),
    )
    return replace(map_, landmarks=landmarks, observations=observations)
