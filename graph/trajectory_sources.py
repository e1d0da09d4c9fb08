"""A trajectory from whatever holds one: a map, a recording, or a text file; the content says which."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapstream.graph.fit import topics_for
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.maps import load_map
from mapstream.recordings.maps.store import MANIFEST
from mapstream.recordings.recording import open_recording
from mapstream.recordings.trajectory_files import (
    read_corrected,
    read_euroc,
    read_kitti,
    read_tum,
)
from mapstream.streams.errors import MapError, RecordingError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.trajectory import Trajectory

TRUTH = "/truth"  # the topic that synthetic recordings have
_RECORDINGS = (".mcap", ".bag", ".db3")
_READERS: dict[int, Callable[[Path], Trajectory]] = {  # by the numbers in a line
    5: lambda path: read_corrected(path)[1],
    8: read_tum,
    12: read_kitti,
}


def read_trajectory(
    path: Path, *, topic: str | None = None, mission: str | None = None
) -> Trajectory:
    """Read a trajectory.

    Args:
        path: The folder of a map, a recording, or a TUM, KITTI or EuRoC file, or corrected poses of a laser log.
        topic: Of a recording: the topic with the poses; `/truth` or the only one by default.
        mission: Of a map: the first digits of the mission's id; needed if there are several.

    Raises:
        MapError: If the map has no such mission, or several.
        RecordingError: If the file holds no trajectory.
    """
    if (path / MANIFEST).is_file():
        return _of_map(path, mission or "")
    if path.is_dir() or path.suffix in _RECORDINGS:
        return _of_recording(path, topic)
    line = _first_line(path)
    if "," in line:
        return read_euroc(path)
    read = _READERS.get(len(line.split()))
    if read is None:
        raise RecordingError(
            f"{path}: no trajectory: expected 8 numbers a line (TUM), 12 (KITTI), 5 (corrected laser log)"
            f" or commas (EuRoC), found {line[:60]!r}"
        )
    return read(path)


def _of_map(path: Path, mission: str) -> Trajectory:
    map_ = load_map(path, tables=["missions", "vertices"])
    ids = [map_.mission_id(row) for row in range(len(map_.missions))]
    rows = [row for row, found in enumerate(ids) if found.startswith(mission)]
    if len(rows) != 1:
        wanted = f"{len(rows)} missions that start with {mission!r}" if mission else "the missions"
        raise MapError(f"{path}: has {wanted}: {', '.join(ids) or 'none'}; choose with --mission")
    vertices = map_.vertices_of(rows[0])
    return Trajectory(stamps_ns=map_.vertices.stamp_ns[vertices], poses=map_.T_map_base(vertices))


def _of_recording(path: Path, topic: str | None) -> Trajectory:
    with open_recording(path) as recording:
        there = [found.name for found in topics_for(Odometry, recording)]
        chosen = topic or (TRUTH if TRUTH in there else there[0] if len(there) == 1 else None)
        if chosen not in there:
            what = f"no poses on {chosen}" if chosen else "no topic is given"
            names = ", ".join(there) or "none"
            raise RecordingError(f"{path}: {what}; topics with poses: {names}; choose with --topic")
        decode = decoder_for(recording.topics[chosen].channel, Odometry)
        poses = [decode(raw) for raw in recording.messages([chosen])]
    stamps_ns = np.array([message.stamp_ns for message in poses], np.int64)
    _, first = np.unique(stamps_ns, return_index=True)  # in order, without repeated ones
    matrices = np.array([m.T_odom_base.matrix for m in poses]).reshape(-1, 4, 4)  # type: ignore[attr-defined]  # Odometry
    return Trajectory(stamps_ns=stamps_ns[first], poses=matrices[first])


def _first_line(path: Path) -> str:
    """Return the first line that is neither empty nor a comment."""
    try:
        with path.open(encoding="utf-8") as lines:
            return next((line for line in lines if line.strip() and line[0] != "#"), "").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
