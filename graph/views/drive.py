"""A mission of a stored map over time: the robot with its cameras on its way, and its states as plots."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import AXES, mission_color
from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.scene import Columns, Entry, transform
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.cameras import Camera, cameras_of
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import quat_xyzw_from_rotation

STATES = "/states"
_STATES = ("velocity_mps", "gyro_bias_radps", "accel_bias_mps2")
_PYRAMID_M = 0.3  # of a camera's picture


def drive_entries(map_: Map) -> list[Entry | Columns]:
    """Return each mission's robot at its poses over time, with its cameras, and plots of its states."""
    drawing: list[Entry | Columns] = []
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        if len(rows):
            drawing += [*_robot(map_, mission, rows), *_plots(map_, mission, rows)]
    return drawing


def robot_path(map_: Map, mission: int) -> str:
    """Return where a mission's robot is drawn."""
    return f"{MAP_PATH}/robots/{map_.mission_id(mission)[:8]}"


def picture_path(map_: Map, mission: int, frame: str, topic: str) -> str:
    """Return where a picture is drawn: in its camera's pyramid, or by its topic where the camera is not known."""
    if frame in cameras_of(map_, mission):
        return f"{robot_path(map_, mission)}/{rr.escape_entity_path_part(frame)}"
    return f"/pictures/{map_.mission_id(mission)[:8]}/{rr.escape_entity_path_part(topic)}"


def _robot(map_: Map, mission: int, rows: IntArray) -> list[Entry | Columns]:
    path, poses = robot_path(map_, mission), map_.T_map_base(rows)
    moves = rr.Transform3D.columns(
        translation=poses[:, :3, 3].astype(np.float32),
        quaternion=quat_xyzw_from_rotation(poses[:, :3, :3]).astype(np.float32),
    )
    body = rr.Boxes3D(half_sizes=[0.15, 0.1, 0.06], colors=mission_color(mission))
    cameras = cameras_of(map_, mission)
    return [
        Columns(path, map_.vertices.stamp_ns[rows], moves),
        Entry.of(f"{path}/body", body, is_static=True),
        *(
            _camera(f"{path}/{rr.escape_entity_path_part(name)}", camera)
            for name, camera in cameras.items()
        ),
    ]


def _camera(path: str, camera: Camera) -> Entry:
    calibration = camera.calibration
    pyramid = rr.Pinhole(
        image_from_camera=calibration.camera_matrix,
        resolution=[calibration.width_px, calibration.height_px],
        image_plane_distance=_PYRAMID_M,
    )
    return Entry.of(path, transform(camera.T_base_sensor), pyramid, is_static=True)


def _plots(map_: Map, mission: int, rows: IntArray) -> list[Entry | Columns]:
    """Return the plots of what is known of velocity and biases."""
    drawing: list[Entry | Columns] = []
    for name in _STATES:
        values: FloatArray = getattr(map_.vertices, name)[rows]
        is_known = np.isfinite(values).all(axis=1)
        if not is_known.any():
            continue
        path = f"{STATES}/{map_.mission_id(mission)[:8]}/{name}"
        style = rr.SeriesLines(names=["x", "y", "z"], colors=AXES)
        columns = rr.Scalars.columns(scalars=values[is_known].reshape(-1))
        stamps_ns = map_.vertices.stamp_ns[rows[is_known]]
        drawing.append(Entry.of(path, style, is_static=True))
        drawing.append(Columns(path, stamps_ns, columns.partition([3] * int(is_known.sum()))))
    return drawing
