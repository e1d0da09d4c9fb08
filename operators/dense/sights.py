"""What the vertices of a map saw, one view after another, where the poses of now put it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from mapstream.operators.dense.cloud_integration import CloudView
from mapstream.operators.dense.depth_views import ColorView, DepthView, Lenses
from mapstream.operators.dense.recorded import DepthImage, kind_of, record_rows_of, recorded_at
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import DecodeError, MapError, RecordingError
from mapstream.streams.messages.sensors import CameraFrame, LidarScan
from mapstream.streams.trajectory import Trajectory

DEPTH = "depth"
"""Kind of resources that are depth images in the map's folder, [mm] in 16 bits: `depth/CAMERA/STAMP.png`."""
_CLOUD = "cloud"
_UNREAD = "vertices whose depth images are not in the recording any more, or damaged"
_COLORS = ("rgb8", "bgr8", "mono8")


@dataclass(frozen=True, slots=True)
class Reach:
    """Which distances are taken for true."""

    least_m: float
    most_m: float


def depth_rows(map_: Map, vertices: IntArray) -> IntArray:
    """Return the resources of vertices that are depth images, in the map's folder or in recordings.

    Raises:
        RecordingError: If a recording is not there.
    """
    resources = map_.resources
    files = np.flatnonzero((resources.kind == DEPTH) & np.isin(resources.vertex, vertices))
    if len(files):
        return files
    return record_rows_of(map_, (DepthImage,), vertices)


def cloud_rows(map_: Map, vertices: IntArray) -> IntArray:
    """Return the resources of vertices that are clouds in the map's folder."""
    resources = map_.resources
    is_cloud = (resources.kind == _CLOUD) & (resources.topic == "")
    return np.flatnonzero(is_cloud & np.isin(resources.vertex, vertices))


def depth_views(
    map_: Map,
    folder: Path,
    rows: IntArray,
    reach: Reach,
    left_out: dict[str, int],
    *,
    has_colors: bool,
) -> Iterator[DepthView]:
    """Yield depth images with the colours of their vertex; vertices without one that can be read are counted.

    Raises:
        MapError, RecordingError, OperatorError: As `views_by_vertex`.
    """
    for _, views in views_by_vertex(map_, folder, rows, reach, left_out, has_colors=has_colors):
        yield from views


def views_by_vertex(
    map_: Map,
    folder: Path,
    rows: IntArray,
    reach: Reach,
    left_out: dict[str, int],
    *,
    has_colors: bool,
) -> Iterator[tuple[int, list[DepthView]]]:
    """Yield vertices with their depth images, and with the colours that were seen from nearest by.

    Raises:
        MapError: If a file is missing or damaged.
        RecordingError: If a recording is not there.
        OperatorError: If nothing is known of a camera.
    """
    poses, lenses = Poses(map_), Lenses()
    near_far = reach.least_m, reach.most_m
    for vertex, frames in _frames(map_, folder, rows, has_colors=has_colors):
        depths = [frame for frame in frames if kind_of(frame) is DepthImage]
        colors = [
            lenses.color_view(frame, poses.at(vertex, frame.stamp_ns))
            for frame in frames
            if frame.encoding in _COLORS
        ]
        if not depths:
            left_out[_UNREAD] = left_out.get(_UNREAD, 0) + 1
        views = [
            lenses.depth_view(depth, poses.at(vertex, depth.stamp_ns), reach_m=near_far)
            for depth in depths
        ]
        yield vertex, [replace(view, color=_nearest(view, colors)) for view in views]


def cloud_views(
    map_: Map, folder: Path, rows: IntArray, reach: Reach, *, has_colors: bool
) -> Iterator[CloudView]:
    """Yield clouds, as seen from where their sensor sits on the base, if the recording says it; else from the base.

    Raises:
        MapError: If a file is missing or damaged.
    """
    origins: dict[int, FloatArray] = {}
    resources = map_.resources
    for row in rows.tolist():
        vertex = int(resources.vertex[row])
        mission = int(map_.vertices.mission[vertex])
        if mission not in origins:
            origins[mission] = lidar_place(map_, mission)
        cloud = read_cloud(folder / resources.path[row])
        points = cloud.points.astype(np.float64)
        away_m = np.linalg.norm(points - origins[mission], axis=1)
        keep = (away_m >= reach.least_m) & (away_m <= reach.most_m)
        T_map_base = map_.T_map_base(np.array([vertex]))[0]
        rgb = None
        if has_colors and cloud.colors_rgba is not None:
            is_colored = cloud.colors_rgba[keep, 3:] > 0
            rgb = np.where(is_colored, cloud.colors_rgba[keep, :3], np.nan).astype(np.float32)
        R, t = T_map_base[:3, :3], T_map_base[:3, 3]
        yield CloudView(points=points[keep] @ R.T + t, origin=R @ origins[mission] + t, rgb=rgb)


def lidar_place(map_: Map, mission: int) -> FloatArray:
    """Return where the LiDAR of a mission sits on its base (3,) [m]; zero where no recording says it."""
    vertices = np.flatnonzero(map_.vertices.mission == mission)
    try:
        rows = record_rows_of(map_, (LidarScan,), vertices)
        first = next(recorded_at(map_, rows[:1]), None)
    except (RecordingError, DecodeError):
        first = None  # the clouds are enough without the recording
    if first is None or not isinstance(first.message, LidarScan):
        return np.zeros(3)
    return first.message.T_base_sensor.t


def _frames(
    map_: Map, folder: Path, rows: IntArray, *, has_colors: bool
) -> Iterator[tuple[int, list[CameraFrame]]]:
    """Yield vertices with the depth images of some resources, and their colours, as soon as all of one are read."""
    resources = map_.resources
    is_recorded = resources.kind[rows] == "record"
    files: dict[int, list[int]] = {}
    for row in rows[~is_recorded].tolist():
        files.setdefault(int(resources.vertex[row]), []).append(row)
    records = rows[is_recorded]
    vertices = np.unique(resources.vertex[rows])
    if has_colors:
        colors = record_rows_of(map_, (CameraFrame,), vertices)
        records = np.concatenate([records, colors])
    num_missing = Counter(resources.vertex[records].tolist())
    read: dict[int, list[CameraFrame]] = {vertex: [] for vertex in vertices.tolist()}

    def complete(vertex: int) -> tuple[int, list[CameraFrame]]:
        of_files = [read_depth(map_, folder, row) for row in files.get(vertex, ())]
        return vertex, read.pop(vertex) + of_files

    for found in recorded_at(map_, records):
        if isinstance(found.message, CameraFrame):
            read[found.vertex].append(found.message)
        num_missing[found.vertex] -= 1
        if not num_missing[found.vertex]:
            yield complete(found.vertex)
    for vertex in sorted(read):
        yield complete(vertex)


def read_depth(map_: Map, folder: Path, row: int) -> CameraFrame:
    """Return a depth image that lies in the map's folder.

    Raises:
        MapError: If it is missing or damaged, or the mission does not describe its camera.
    """
    path = folder / map_.resources.path[row]
    name = path.parent.name
    vertex = int(map_.resources.vertex[row])
    camera = cameras_of(map_, int(map_.vertices.mission[vertex])).get(name)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or camera is None:
        what = "its camera is not described" if camera is None else "missing or damaged"
        raise MapError(f"{path}: {what}; compute depth anew (stereo-depth)")
    return CameraFrame(
        stamp_ns=int(map_.vertices.stamp_ns[vertex]),
        image=image,
        encoding="16UC1",
        frame=name,
        T_base_sensor=camera.T_base_sensor,
        camera=camera.calibration,
    )


def _nearest(view: DepthView, colors: list[ColorView]) -> ColorView | None:
    """Return the colours that were seen from nearest by, looking the same way."""
    T = view.pinhole.T_map_camera

    def apart(color: ColorView) -> float:
        other = color.pinhole.T_map_camera
        return float(np.linalg.norm(other[:3, 3] - T[:3, 3]) + 1 - other[:3, 2] @ T[:3, 2])

    return min(colors, key=apart, default=None)


class Poses:
    """Where the base was at the stamps of images, between vertices if need be."""

    def __init__(self, map_: Map) -> None:
        self._map = map_
        self._of_mission: dict[int, Trajectory] = {}

    def at(self, vertex: int, stamp_ns: int) -> FloatArray:
        """Return T_map_base (4, 4) at a stamp near that of a vertex; beyond the ends it is the vertex's."""
        mission = int(self._map.vertices.mission[vertex])
        if mission not in self._of_mission:
            rows = self._map.vertices_of(mission)
            self._of_mission[mission] = Trajectory(
                stamps_ns=self._map.vertices.stamp_ns[rows], poses=self._map.T_map_base(rows)
            )
        trajectory = self._of_mission[mission]
        is_inside = trajectory.covers(stamp_ns)
        own_ns = int(self._map.vertices.stamp_ns[vertex])
        pose: FloatArray = trajectory.at(stamp_ns if is_inside else own_ns)[0]
        return pose
