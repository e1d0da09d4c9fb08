"""Maps from files of other tools; the suffix of the file chooses the format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.tables import Edges, Vertices
from mapstream.recordings.trajectory_files import read_euroc, read_kitti, read_tum
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert
from mapstream.streams.trajectory import Trajectory


class ImportConfig(OperatorConfig):
    """What the edges of an imported trajectory are worth, for one step."""

    rotation_sigma_rad: PositiveFloat = 0.01
    translation_sigma_m: PositiveFloat = 0.05


def import_map(path: Path, config: ImportConfig) -> Map:
    """Read a `.g2o` graph, or a `.tum`, `.kitti` or `.csv` (EuRoC) trajectory with odometry edges.

    Raises:
        MapError: If the suffix is of no known format.
        RecordingError: If the file is not understood; the message has the line.
    """
    read = IMPORTERS.get(path.suffix.lower())
    if read is None:
        raise MapError(f"{path}: unknown format {path.suffix!r}; known are {', '.join(IMPORTERS)}")
    return read(path, config)


def trajectory_map(trajectory: Trajectory, name: str, config: ImportConfig) -> Map:
    """Return a map of one mission with a vertex per pose and an odometry edge per step."""
    mission, num_vertices = mission_id(name), len(trajectory)
    vertices = Vertices(
        id=vertex_ids(mission, trajectory.stamps_ns),
        mission=np.zeros(num_vertices, dtype=np.int64),
        stamp_ns=trajectory.stamps_ns,
        T_mission_base=trajectory.poses,
    )
    map_ = replace(new_mission(Map.empty(), mission, name=name), vertices=vertices)
    num_edges = max(num_vertices - 1, 0)
    variances = [config.rotation_sigma_rad**2] * 3 + [config.translation_sigma_m**2] * 3
    edges = Edges(
        kind=np.full(num_edges, "odometry", dtype=object),
        vertex_a=np.arange(num_edges),
        vertex_b=np.arange(num_edges) + 1,
        T_a_b=invert(trajectory.poses[:-1]) @ trajectory.poses[1:],
        covariance=np.tile(np.diag(variances), (num_edges, 1, 1)),
        source=np.full(num_edges, "import", dtype=object),
    )
    return append_edges(map_, edges)


def _g2o(path: Path, config: ImportConfig) -> Map:  # noqa: ARG001  # g2o has its own covariances
    return read_g2o(path)


def _tum(path: Path, config: ImportConfig) -> Map:
    return trajectory_map(read_tum(path), path.name, config)


def _kitti(path: Path, config: ImportConfig) -> Map:
    return trajectory_map(read_kitti(path), path.name, config)


def _euroc(path: Path, config: ImportConfig) -> Map:
    return trajectory_map(read_euroc(path), path.name, config)


IMPORTERS: dict[str, Callable[[Path, ImportConfig], Map]] = {
    ".tum": _tum,
    ".kitti": _kitti,
    ".csv": _euroc,
    ".g2o": _g2o,
}
