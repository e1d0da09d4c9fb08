"""Decoding ROS 2 messages against `mcap-ros2-support`, over messages that are new to the cache each time.

The clouds have 65,536 points x y z intensity (1 MB). `to a view` is what the other gives, too: all fields,
the points as one buffer. `to a scan` also takes out points that are not finite and copies the rest, so
that the recording's chunk can be freed; the other side then does the same with numpy.
Processor time of the thread, medians of several rounds in which both sides take turns.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.decoding.cursor import CdrCursor
from mapstream.recordings.decoding.ros_clouds import PointCloudReader
from mapstream.recordings.recording import RawMessage
from tests.recordings.decoding.made_ros import cloud, header, imu, make, raw, store

ROUNDS, COUNT = 7, 60
_POINT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]


def _theirs(message: RawMessage) -> Callable[[bytes], Any]:
    name = message.channel.schema_name
    text, _ = store("cdr").generate_msgdef(name, ros_version=2)
    schema = Schema(id=1, name=name, encoding="ros2msg", data=text.encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    if decode is None:
        raise RuntimeError(f"mcap-ros2-support has no decoder for {name}")
    return decode


def _copies(message: RawMessage) -> list[RawMessage]:
    """Return messages of equal content in memory of their own."""
    content = bytes(message.data)
    return [
        RawMessage(message.channel, 0, 0, 0, memoryview(content[:1] + content[1:]))
        for _ in range(COUNT)
    ]


def _microseconds(functions: Sequence[Callable[[], object]], count: int = COUNT) -> list[float]:
    """Return the time per message; each function decodes `count` messages and returns all of them."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(ROUNDS):
        for function, spent in zip(functions, times, strict=True):
            started = time.thread_time()
            kept = function()
            spent.append(time.thread_time() - started)
            del kept
    return [statistics.median(spent) / count * 1e6 for spent in times]


def _row(what: str, mine: float, other: float, bar: str = "") -> Row:
    return Row(
        what=what, ours=f"{mine:.2f} us", other=f"mcap-ros2-support {other:.1f} us",
        ratio=other / mine, bar=bar,
    )  # fmt: skip


def _clouds() -> list[Row]:
    rng = np.random.default_rng(0)
    points = np.zeros(65_536, _POINT)
    for name in "xyz":
        points[name] = rng.normal(size=len(points))
    messages = _copies(cloud("cdr", points))
    theirs, reader, ours = (
        _theirs(messages[0]),
        PointCloudReader(Counter()),
        decoder_for(messages[0].channel),
    )
    contents = [bytes(message.data) for message in messages]

    def their_scan(content: bytes) -> object:
        found = np.frombuffer(theirs(content).data, _POINT)
        xyz = np.stack([found["x"], found["y"], found["z"]], axis=1)
        is_finite = np.isfinite(xyz).all(axis=1)
        return xyz[is_finite], found["intensity"][is_finite]

    view, scan, other, other_scan = _microseconds(
        [
            lambda: [reader.view(CdrCursor(message.data)) for message in messages],
            lambda: [ours(message) for message in messages],
            lambda: [theirs(content) for content in contents],
            lambda: [their_scan(content) for content in contents],
        ]
    )
    return [
        _row("PointCloud2 of 1 MB to a view", view, other, "at least 20"),
        _row("PointCloud2 of 1 MB to a scan", scan, other_scan),
    ]


def _imu() -> list[Row]:
    messages = [imu("cdr", k) for k in range(COUNT)] * 20
    contents = [bytes(message.data) for message in messages]
    theirs, ours = _theirs(messages[0]), decoder_for(messages[0].channel)
    by_100 = [messages[i : i + 100] for i in range(0, len(messages), 100)]
    by_10 = [messages[i : i + 10] for i in range(0, len(messages), 10)]
    batch, ten, alone, other = _microseconds(
        [
            lambda: [ours.many(some) for some in by_100],
            lambda: [ours.many(some) for some in by_10],
            lambda: [ours(message) for message in messages],
            lambda: [theirs(content) for content in contents],
        ],
        len(messages),
    )
    return [
        _row("Imu in batches of 100", batch, other, "at least 8"),
        _row("Imu in batches of 10, as the source reads 200 Hz", ten, other),
        _row("Imu one by one", alone, other),
    ]


def _image() -> list[Row]:
    pixels = np.zeros(640 * 480, np.uint8)
    fields = {"header": header("cdr", "camera"), "height": 480, "width": 640, "encoding": "mono8",
              "is_bigendian": 0, "step": 640, "data": pixels}  # fmt: skip
    message = raw("cdr", "sensor_msgs/Image", make("cdr", "sensor_msgs/Image", **fields))
    messages = _copies(message)
    contents = [bytes(message.data) for message in messages]
    theirs, ours = _theirs(message), decoder_for(message.channel)
    mine, other = _microseconds(
        [lambda: [ours(m) for m in messages], lambda: [theirs(content) for content in contents]]
    )
    return [_row("Image of 307 KB", mine, other)]


def run() -> list[Row]:
    """Return a row for each comparison."""
    return _clouds() + _imu() + _image()


if __name__ == "__main__":
    print(markdown(run()))
