"""What a converter of a data set does, and what it says about it."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import ImuBatch, Message

Progress = Callable[[float], None]  # told the fraction done
Topical = tuple[str, Message]  # a message and its topic
Notices = tuple[str, ...]  # what a user should know of the result
Convert = Callable[[Path, McapWriter, Progress], Notices]

_BATCH = 10  # IMU samples in a message
_FIELDS = 4  # x, y, z [m], intensity


@dataclass(frozen=True, slots=True)
class BinScan:
    """A file of float32 `x y z intensity`, without the points that are not finite."""

    points: Float32Array  # (N, 3) [m]
    intensity: Float32Array  # (N,)
    num_dropped: int


def bin_files(folder: Path) -> list[Path]:
    """Return the `.bin` files of a folder in the order of their names.

    Raises:
        RecordingError: If there are none.
    """
    files = sorted(folder.glob("*.bin"))
    if not files:
        raise RecordingError(f"{folder}: expected a folder with .bin files, found none in it")
    return files


def read_bin(path: Path) -> BinScan:
    """Read one scan.

    Raises:
        RecordingError: If the file cannot be read, or is no sequence of such points.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    if len(content) % (4 * _FIELDS):
        raise RecordingError(
            f"{path}: expected points of {4 * _FIELDS} bytes (float32 x y z intensity), found"
            f" {len(content)} bytes, which leaves {len(content) % (4 * _FIELDS)} over"
        )
    rows = np.frombuffer(content, "<f4").reshape(-1, _FIELDS)
    finite = np.isfinite(rows).all(axis=1)
    kept = rows[finite]
    return BinScan(kept[:, :3], kept[:, 3], int(len(rows) - len(kept)))


def drop_notice(num_dropped: int) -> Notices:
    """Say how many points were left out."""
    return (f"{num_dropped} points that were not finite were left out",) if num_dropped else ()


def imu_batches(
    topic: str, stamps_ns: IntArray, gyro_radps: FloatArray, accel_mps2: FloatArray
) -> Iterator[Topical]:
    """Yield samples (N,), (N, 3), (N, 3) in messages of a few."""
    for first in range(0, len(stamps_ns), _BATCH):
        part = slice(first, first + _BATCH)
        batch = ImuBatch(
            stamps_ns=stamps_ns[part], gyro_radps=gyro_radps[part], accel_mps2=accel_mps2[part]
        )
        yield topic, batch


def write_in_order(
    writer: McapWriter,
    streams: Iterable[Iterable[Topical]],
    span_ns: tuple[int, int],
    on_progress: Progress,
) -> None:
    """Write streams of messages, each in the order of its stamps, as one.

    Raises:
        RecordingError: If the disk is full.
    """
    start_ns, end_ns = span_ns
    for topic, message in heapq.merge(*streams, key=lambda item: item[1].stamp_ns):
        writer.write(topic, message)
        on_progress((message.stamp_ns - start_ns) / max(end_ns - start_ns, 1))
