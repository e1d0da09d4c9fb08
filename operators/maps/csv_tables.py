"""A map as CSV files in a folder, for spreadsheets and scripts; docs/map-tools.md lists the columns.

Poses, velocities and landmarks are in the map frame; numbers come back exactly; `nan` is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pyarrow import csv

from mapstream.operators.maps.naming import things
from mapstream.operators.maps.regions import regions_of
from mapstream.operators.maps.where import described
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import quat_xyzw_from_rotation

Columns = Mapping[str, npt.ArrayLike]


def _axes(name: str) -> tuple[str, ...]:
    return tuple(name.format(axis) for axis in "xyz")


_POSITION, _ROTATION = _axes("{}_m"), ("qx", "qy", "qz", "qw")
_SIGMAS = (*_axes("sigma_r{}_rad"), *_axes("sigma_{}_m"))


def write_tables(map_: Map, folder: Path) -> dict[Path, int]:
    """Write one file per table, and return how many rows each has.

    Raises:
        RecordingError: If the folder cannot be made, or a file not be written.
    """
    tables = {
        "missions": _missions(map_),
        "vertices": _vertices(map_),
        "edges": _edges(map_),
        "landmarks": _landmarks(map_),
        "observations": _observations(map_),
        "imu": _imu(map_),
        "objects": _objects(map_),
        "regions": _regions(map_),
    }
    written = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, columns in tables.items():
            table = pa.table({key: pa.array(np.asarray(v)) for key, v in columns.items()})
            csv.write_csv(table, folder / f"{name}.csv")
            written[folder / f"{name}.csv"] = len(table)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error}") from error
    return written


def _named(names: tuple[str, ...], values: npt.NDArray[np.floating]) -> dict[str, npt.ArrayLike]:
    return dict(zip(names, np.asarray(values, dtype=np.float64).T, strict=True))


def _pose(T: FloatArray) -> dict[str, npt.ArrayLike]:
    return _named(_POSITION, T[:, :3, 3]) | _named(_ROTATION, quat_xyzw_from_rotation(T[:, :3, :3]))


def _missions(map_: Map) -> Columns:
    missions = map_.missions
    rows = [map_.vertices_of(row) for row in range(len(missions))]
    stamps_ns = [map_.vertices.stamp_ns[r] for r in rows]
    return {
        "mission": np.array([map_.mission_id(row) for row in range(len(missions))], dtype=object),
        "name": missions.name,
        "is_base_frame_known": missions.is_base_frame_known,
        **_pose(missions.T_map_mission),
        "num_vertices": np.array([len(r) for r in rows], dtype=np.int64),
        "start_ns": np.array([s[0] if len(s) else 0 for s in stamps_ns], dtype=np.int64),
        "end_ns": np.array([s[-1] if len(s) else 0 for s in stamps_ns], dtype=np.int64),
        "sensors": missions.sensors,
    }


def _mission_ids(map_: Map, vertex_rows: npt.NDArray[np.int64]) -> npt.NDArray[np.object_]:
    ids = np.array([*(map_.mission_id(row) for row in range(len(map_.missions))), ""], dtype=object)
    found: npt.NDArray[np.object_] = ids[np.append(map_.vertices.mission, -1)[vertex_rows]]
    return found


def _vertices(map_: Map) -> Columns:
    vertices, rows = map_.vertices, np.arange(len(map_.vertices))
    R_map_mission = map_.missions.T_map_mission[vertices.mission, :3, :3]
    velocity = (R_map_mission @ vertices.velocity_mps[:, :, None])[..., 0]
    return {
        "vertex": rows,
        "mission": _mission_ids(map_, rows),
        "stamp_ns": vertices.stamp_ns,
        **_pose(map_.T_map_base(rows)),
        **_named(_axes("v{}_mps"), velocity),
        **_named(_axes("gyro_bias_{}_radps"), vertices.gyro_bias_radps),
        **_named(_axes("accel_bias_{}_mps2"), vertices.accel_bias_mps2),
    }


def _edges(map_: Map) -> Columns:
    edges = map_.edges
    sigmas = np.sqrt(np.diagonal(edges.covariance, axis1=1, axis2=2))
    return {
        "edge": np.arange(len(edges)),
        "kind": edges.kind,
        "source": edges.source,
        "vertex_a": edges.vertex_a,
        "vertex_b": edges.vertex_b,
        "landmark_a": edges.landmark_a,
        "landmark_b": edges.landmark_b,
        "frame": np.append(map_.frames.name, "")[edges.frame],
        **_pose(edges.T_a_b),
        **_named(_SIGMAS, sigmas),
        "is_switchable": edges.is_switchable,
        "switch": edges.switch,
    }


def _landmarks(map_: Map) -> Columns:
    landmarks, rows = map_.landmarks, np.arange(len(map_.landmarks))
    T_map_landmark = map_.T_map_landmark(rows)
    rotation = quat_xyzw_from_rotation(T_map_landmark[:, :3, :3])
    rotation[np.isnan(landmarks.quat_base_xyzw).any(axis=1)] = np.nan
    seen = map_.observations.landmark
    return {
        "landmark": rows,
        "kind": landmarks.kind,
        "label": landmarks.label,
        "quality": landmarks.quality,
        **_named(_POSITION, T_map_landmark[:, :3, 3]),
        **_named(_ROTATION, rotation),
        "num_observations": np.bincount(seen[seen >= 0], minlength=len(rows)),
    }


def _observations(map_: Map) -> Columns:
    seen = map_.observations
    return {
        "vertex": seen.vertex,
        "landmark": seen.landmark,
        "sensor": seen.sensor,
        "kind": seen.kind,
        "track": seen.track,
        "offset_ns": seen.offset_ns,
        **_named(("u_px", "v_px"), seen.keypoint_px),
        **_named(_axes("{}_sensor_m"), seen.p_sensor),
        "sigma": seen.sigma,
        "sigma_m": seen.sigma_m,
        "score": seen.score,
        "scale_px": seen.scale,
        "orientation_rad": seen.orientation_rad,
    }


def _imu(map_: Map) -> Columns:
    imu = map_.imu
    return {
        "edge": imu.edge,
        "mission": _mission_ids(map_, map_.edges.vertex_a[imu.edge]),
        "stamp_ns": imu.stamp_ns,
        **_named(_axes("gyro_{}_radps"), imu.gyro_radps),
        **_named(_axes("accel_{}_mps2"), imu.accel_mps2),
    }


def _objects(map_: Map) -> Columns:
    """Return landmarks that people may ask for: with a class, a name or an outline."""
    rows = things(map_)
    found = described(map_, rows.tolist())
    unknown = np.full(4, np.nan)
    turns = [unknown if thing.quat_xyzw is None else thing.quat_xyzw for thing in found]
    sizes = [unknown[:3] if thing.extent_m is None else thing.extent_m for thing in found]
    return {
        "landmark": rows,
        **{
            column: np.array([getattr(thing, column) for thing in found], dtype=object)
            for column in ("id", "kind", "label", "name", "text")
        },
        **_named(_POSITION, np.array([thing.position for thing in found]).reshape(-1, 3)),
        **_named(_ROTATION, np.array(turns).reshape(-1, 4)),
        **_named(_axes("size_{}_m"), np.array(sizes).reshape(-1, 3)),
        "region": np.array([next(iter(thing.regions), "") for thing in found], dtype=object),
        "num_observations": np.array([thing.num_observations for thing in found], np.int64),
    }


def _regions(map_: Map) -> Columns:
    """Return the corners of regions, a row each."""
    regions = regions_of(map_)
    counts = [len(region.corners) for region in regions]
    corners = np.concatenate([np.empty((0, 3)), *(region.corners for region in regions)])
    return {
        "region": np.repeat(np.array([r.name for r in regions], dtype=object), counts),
        "kind": np.repeat(np.array([r.kind for r in regions], dtype=object), counts),
        "corner": np.concatenate([np.empty(0, np.int64), *map(np.arange, counts)]),
        **_named(_POSITION, corners),
        "height_m": np.repeat(np.array([r.height_m for r in regions], np.float64), counts),
    }
