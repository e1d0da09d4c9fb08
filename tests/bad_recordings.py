"""Recordings with one thing wrong each, made when a test asks for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mapstream.recordings.mcap_layout import from_summary
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import Channel
from mapstream.recordings.worlds.box_room import box_room, drive_through
from mapstream.recordings.worlds.sensors import LidarConfig
from mapstream.streams.messages.sensors import LidarScan
from tests.recordings.decoding.made_ros import cloud, header

Points = np.ndarray[Any, np.dtype[np.void]]  # as a PointCloud2 holds them
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
_LIDAR = LidarConfig(beams=16, columns=90, range_noise_m=0.005, dropout=0.0)


@cache
def drive(num_scans: int = 16) -> Sequence[LidarScan]:
    """Return scans of a drive through a room, 0.2 m apart."""
    return drive_through(box_room(), num_scans=num_scans, speed_mps=2.0, lidar=_LIDAR).scans


def record(path: Path, scans: Iterable[LidarScan] | None = None, *, topic: str = "/points") -> Path:
    """Write scans in our own schema, some in each chunk."""
    with McapWriter(path, chunk_bytes=60_000) as writer:
        for scan in drive() if scans is None else scans:
            writer.write(topic, scan)
    return path


def record_clouds(
    path: Path,
    change: Callable[[int, Points], Points] = lambda _, points: points,
    *,
    stamp: Callable[[int, int], int] = lambda _, stamp_ns: stamp_ns,
    encoding: str = "cdr",
    schema: str | None = None,
) -> Path:
    """Write a drive as PointCloud2 of ROS 2.

    Args:
        path: Where to.
        change: What happens to the points of the scan with that index.
        stamp: What happens to its stamp; the log time stays.
        encoding: What the channel says of its encoding.
        schema: What it says of its schema; empty for none.
    """
    with McapWriter(path, chunk_bytes=60_000) as writer:
        for i, scan in enumerate(drive()):
            head = header("cdr", "lidar", stamp(i, scan.stamp_ns))
            raw = cloud("cdr", change(i, as_points(scan)), header=head)
            name = raw.channel.schema_name if schema is None else schema
            channel = Channel(topic="/points", message_encoding=encoding, schema_name=name)
            writer.write_raw(channel, raw.data, scan.stamp_ns)
    return path


def as_points(scan: LidarScan) -> Points:
    """Return the points of a scan with their times."""
    points = np.zeros(len(scan.points), POINT)
    for axis, name in enumerate("xyz"):
        points[name] = scan.points[:, axis]
    points["t"] = scan.offsets_ns
    return points


def truncate(path: Path, fraction: float = 0.6) -> Path:
    """Cut a file off, as a recorder leaves it that loses power."""
    content = path.read_bytes()
    path.write_bytes(content[: round(len(content) * fraction)])
    return path


def flip(path: Path, chunk: int) -> int:
    """Change a byte in the middle of a chunk; return where the chunk begins."""
    content = bytearray(path.read_bytes())
    segment = sorted(from_summary(memoryview(content)).segments, key=lambda s: s.offset)[chunk]
    content[segment.data_start + segment.data_size // 2] ^= 0xFF
    path.write_bytes(content)
    return segment.offset
