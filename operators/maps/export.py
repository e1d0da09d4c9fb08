"""Maps to files of other tools; the suffix of the file chooses the format, a name without one is a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.maps.colmap import colmap_model
from mapstream.operators.maps.csv_tables import write_tables
from mapstream.operators.maps.geo_clouds import projection_of
from mapstream.operators.maps.geojson import write_geojson
from mapstream.recordings.cloud_files import write_pcd, write_ply
from mapstream.recordings.colmap import write_model
from mapstream.recordings.g2o import write_g2o
from mapstream.recordings.las_files import write_las
from mapstream.recordings.maps.edge_kinds import RELATIVE_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import write_euroc, write_kitti, write_tum
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, RelativePose
from mapstream.streams.trajectory import Trajectory


class ExportConfig(AggregateConfig):
    """What is exported; the voxels are those of clouds."""

    crs: str = "utm"
    """The projection of `.las` and `.laz`: `utm`, or EPSG:32632 ...; `map` keeps the map's own axes, as a map
    without a place on Earth does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportReport:
    """What was written, and what the format has no place for."""

    files: tuple[Path, ...]
    written: dict[str, int] = field(default_factory=dict)  # poses, edges, points, rows by table
    left_out: dict[str, int] = field(default_factory=dict)  # edges by kind, images by camera


def export_map(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:
    """Write a map as `.tum`, `.kitti`, `.csv` (EuRoC), `.g2o`, `.colmap`, `.ply`, `.pcd`, `.las`, `.laz`, `.mcap`, `.geojson` or CSV tables.

    Args:
        map_: The map.
        folder: Where it lies, for its clouds.
        path: The file, in the map frame; of several missions, trajectories get a file each, with the mission in its name.
            Without a suffix it is a folder, which gets a CSV file per table.
        config: See there.

    Raises:
        MapError: If the suffix is of no known format, or the map has nothing to write there.
        RecordingError: If the file cannot be written.
    """
    export = EXPORTERS.get(path.suffix.lower())
    if export is None:
        raise MapError(f"{path}: unknown format {path.suffix!r}; known are {KNOWN}")
    return export(map_, folder, path, config)


def _trajectories(map_: Map, path: Path, write: Callable[[Path, Trajectory], None]) -> ExportReport:
    missions = [m for m in range(len(map_.missions)) if len(map_.vertices_of(m))]
    if not missions:
        raise MapError(f"{path}: the map has no poses to write")
    files = []
    for mission in missions:
        name = f"{path.stem}-{map_.mission_id(mission)[:8]}{path.suffix}"
        files.append(path if len(missions) == 1 else path.with_name(name))
        rows = map_.vertices_of(mission)
        stamps_ns = map_.vertices.stamp_ns[rows]
        write(files[-1], Trajectory(stamps_ns=stamps_ns, poses=map_.T_map_base(rows)))
    return ExportReport(files=tuple(files), written={"poses": len(map_.vertices)})


def _tum(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    return _trajectories(map_, path, write_tum)


def _kitti(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    return _trajectories(map_, path, write_kitti)


def _euroc(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    return _trajectories(map_, path, write_euroc)


def _g2o(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    left_out = write_g2o(map_, path)
    written = {"poses": len(map_.vertices), "edges": len(map_.edges) - left_out.total()}
    return ExportReport(files=(path,), written=written, left_out=dict(left_out))


def _csv_tables(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    written = write_tables(map_, path)
    rows = {file.stem: count for file, count in written.items()}
    return ExportReport(files=tuple(written), written=rows)


def _colmap(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    model, left_out = colmap_model(map_)
    if not model.images:
        raise MapError(f"{path}: the map has no images of cameras that COLMAP knows")
    written = {"images": len(model.images), "points": len(model.points)}
    return ExportReport(files=write_model(model, path), written=written, left_out=dict(left_out))


def _ply(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:
    cloud = aggregate_cloud(map_, folder, config)
    write_ply(path, cloud.points, cloud.intensity, cloud.colors_rgb)
    return ExportReport(files=(path,), written={"points": len(cloud.points)})


def _pcd(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:
    cloud = aggregate_cloud(map_, folder, config)
    write_pcd(path, cloud.points, cloud.intensity, cloud.colors_rgb)
    return ExportReport(files=(path,), written={"points": len(cloud.points)})


def _las(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:
    cloud = aggregate_cloud(map_, folder, config)
    projection = projection_of(map_, config.crs)
    points = projection.place(cloud.points.astype(np.float64))
    write_las(path, points, cloud.intensity, cloud.colors_rgb, projection.wkt)
    return ExportReport(
        files=(path,), written={f"points in {projection.crs or 'the map frame'}": len(cloud.points)}
    )


def _geojson(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    written = write_geojson(map_, path, in_map_frame=config.crs == "map")
    return ExportReport(files=(path,), written=written)


def _mcap(map_: Map, folder: Path, path: Path, config: ExportConfig) -> ExportReport:  # noqa: ARG001
    """Write poses as Odometry on `/missions/ID/poses`, relative edges on `/edges`, by stamp."""
    is_relative = np.isin(map_.edges.kind, RELATIVE_KINDS) & (map_.edges.vertex_b >= 0)
    messages = [*_pose_messages(map_), *_edge_messages(map_, np.flatnonzero(is_relative))]
    messages.sort(key=lambda entry: entry[1].stamp_ns)  # stable: poses first
    with McapWriter(path) as writer:
        for topic, message in messages:
            writer.write(topic, message)
    written = {"poses": len(map_.vertices), "edges": int(is_relative.sum())}
    left_out = Counter(map_.edges.kind[~is_relative].tolist())
    return ExportReport(files=(path,), written=written, left_out=dict(left_out))


def _pose_messages(map_: Map) -> list[tuple[str, Odometry | RelativePose]]:
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    topics = [f"/missions/{map_.mission_id(row)}/poses" for row in range(len(map_.missions))]
    vertices = map_.vertices
    return [
        (topics[mission], Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T)))
        for mission, stamp_ns, T in zip(
            vertices.mission.tolist(), vertices.stamp_ns.tolist(), poses, strict=True
        )
    ]


def _edge_messages(map_: Map, rows: IntArray) -> list[tuple[str, Odometry | RelativePose]]:
    edges, vertices = map_.edges, map_.vertices
    ids = [map_.mission_id(row) for row in range(len(map_.missions))]
    messages: list[tuple[str, Odometry | RelativePose]] = []
    for row in rows.tolist():
        a, b = edges.vertex_a[row], edges.vertex_b[row]
        message = RelativePose(
            kind=edges.kind[row],
            mission_a=ids[vertices.mission[a]],
            stamp_a_ns=int(vertices.stamp_ns[a]),
            mission_b=ids[vertices.mission[b]],
            stamp_b_ns=int(vertices.stamp_ns[b]),
            T_a_b=edges.T_a_b_of(row),
            covariance=edges.covariance[row],
            source=edges.source[row],
            is_switchable=bool(edges.is_switchable[row]),
        )
        messages.append(("/edges", message))
    return messages


EXPORTERS: dict[str, Callable[[Map, Path, Path, ExportConfig], ExportReport]] = {
    ".tum": _tum,
    ".kitti": _kitti,
    ".csv": _euroc,
    ".g2o": _g2o,
    ".colmap": _colmap,
    ".ply": _ply,
    ".pcd": _pcd,
    ".las": _las,
    ".laz": _las,
    ".mcap": _mcap,
    ".geojson": _geojson,
    "": _csv_tables,
}
KNOWN = ", ".join(filter(None, EXPORTERS)) + ", or a folder for CSV tables"
