"""Maps from files of other tools; the suffix of the file chooses the format, or a name in front of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mapstream.operators.maps.colmap import colmap_map
from mapstream.operators.maps.trajectory_map import ImportConfig, trajectory_map
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.kimera_multi import read_kimera_multi
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.model import Map
from mapstream.recordings.trajectory_files import read_euroc, read_kitti, read_tum
from mapstream.streams.errors import MapError
from mapstream.streams.trajectory import Trajectory


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


def _g2o(paths: Sequence[Path], config: ImportConfig) -> list[Map]:
    return [read_g2o(*paths, are_loops_switchable=config.are_loops_switchable)]


def _kimera_multi(paths: Sequence[Path], config: ImportConfig) -> list[Map]:  # noqa: ARG001  # it has its own covariances
    return [read_kimera_multi(path) for path in paths]


def _trajectories(read: Callable[[Path], Trajectory]) -> Importer:
    def import_(paths: Sequence[Path], config: ImportConfig) -> list[Map]:
        return [trajectory_map(read(path), path.name, config) for path in paths]

    return import_


def _colmap(paths: Sequence[Path], config: ImportConfig) -> list[Map]:
    return [colmap_map(path, config) for path in paths]


Importer = Callable[[Sequence[Path], ImportConfig], list[Map]]
IMPORTERS: dict[str, Importer] = {
    "tum": _trajectories(read_tum),
    "kitti": _trajectories(read_kitti),
    "euroc": _trajectories(read_euroc),
    "g2o": _g2o,
    "kimera-multi": _kimera_multi,
    "colmap": _colmap,
}
_BY_SUFFIX = {".tum": "tum", ".kitti": "kitti", ".csv": "euroc", ".g2o": "g2o", ".colmap": "colmap"}
