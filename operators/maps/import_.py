"""Maps from files of other tools; the suffix of the file chooses the format, or a name in front of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.kimera_multi import read_kimera_multi
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.tables import Edges, Vertices
from mapstream.recordings.trajectory_files import read_euroc, read_kitti, read_tum
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert
from mapstream.streams.trajectory import Trajectory


class ImportConfig(OperatorConfig):
    """What the edges of imported trajectories and pose graphs are worth."""

    rotation_sigma_rad: PositiveFloat = 0.01
    """Of one step of a trajectory."""
    translation_sigma_m: PositiveFloat = 0.05
    """Of one step of a trajectory."""
    are_loops_switchable: bool = True
    """Whether an optimizer may find loops within a mission of a g2o graph false."""


def import_map(sources: Sequence[str | Path], config: ImportConfig) -> Map:
    """Read pose graphs and trajectories, each of which becomes a mission or several.

    Args:
        sources: Each a file whose suffix tells the format, or `FORMAT:PATH` with a name from `IMPORTERS`.
            Several g2o files are one graph (see `read_g2o`); whatever else there are several of is merged.
        config: What trajectories are worth.

    Raises:
        MapError: If a format is not known, or two files are one mission.
        RecordingError: If a file is not understood; the message has the line.
    """
    files: dict[str, list[Path]] = {}
    for source in sources:
        name, path = _parsed(str(source))
        files.setdefault(name, []).append(path)
    return merge_maps(
        [map_ for name, paths in files.items() for map_ in IMPORTERS[name](paths, config)]
    )


def _parsed(source: str) -> tuple[str, Path]:
    """Return the name of the format and the path."""
    name, colon, rest = source.partition(":")
    if colon and name in IMPORTERS:
        return name, Path(rest)
    suffix = Path(source).suffix.lower()
    if suffix not in _BY_SUFFIX:
        known = f"suffixes {', '.join(_BY_SUFFIX)}; or {', '.join(f'{n}:' for n in IMPORTERS)}"
        raise MapError(f"{source}: unknown format {suffix!r}; known are {known}")
    return _BY_SUFFIX[suffix], Path(source)


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


def _g2o(paths: Sequence[Path], config: ImportConfig) -> list[Map]:
    return [read_g2o(*paths, are_loops_switchable=config.are_loops_switchable)]


def _kimera_multi(paths: Sequence[Path], config: ImportConfig) -> list[Map]:  # noqa: ARG001  # it has its own covariances
    return [read_kimera_multi(path) for path in paths]


def _trajectories(read: Callable[[Path], Trajectory]) -> Importer:
    def import_(paths: Sequence[Path], config: ImportConfig) -> list[Map]:
        return [trajectory_map(read(path), path.name, config) for path in paths]

    return import_


Importer = Callable[[Sequence[Path], ImportConfig], list[Map]]
IMPORTERS: dict[str, Importer] = {
    "tum": _trajectories(read_tum),
    "kitti": _trajectories(read_kitti),
    "euroc": _trajectories(read_euroc),
    "g2o": _g2o,
    "kimera-multi": _kimera_multi,
}
_BY_SUFFIX = {".tum": "tum", ".kitti": "kitti", ".csv": "euroc", ".g2o": "g2o"}
