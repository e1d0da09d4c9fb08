"""LiDAR odometry in a graph against the same library in a bare loop: `python benchmarks/odometry.py`.

The recording is the 16 scans and images of `kitti_camera_lidar` driven forwards and backwards, so that it
lasts and nothing jumps. The bare loop reads with the `mcap` package and calls the same decoders, KISS-ICP
with the same settings and one thread, and for the second row OpenCV's decoder and ORB, one after another.
Both sides take turns; the figures are medians, starting of processes included.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from mcap.reader import make_reader

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.features.features import Orb, OrbConfig
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import RawMessage, open_recording

ROUNDS = 3
NUM_LAPS = 8  # there and back
PERIOD_NS = 50_000_000
SCANS, IMAGES = "/velodyne_points", "/camera/image/compressed"
_DATA = Path(os.environ.get("MAPSTREAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
SOURCE = _DATA / "kitti_camera_lidar" / "kitti_camera_lidar.mcap"

ALONE = """
version: 1
name: odometry
operators:
  sensors: {use: mcap, config: {path: PATH, topics: {scans: {topic: /velodyne_points, stamp: log}}}}
  odometry: {use: kiss_odometry, in: {scans: sensors.scans}, config: {voxel_size_m: 1.0}, run: PLACE}
"""
BESIDE = """
version: 1
name: odometry
operators:
  sensors:
    use: mcap
    config:
      path: PATH
      topics:
        scans: {topic: /velodyne_points, stamp: log}
        images: {topic: /camera/image/compressed, stamp: log}
  odometry: {use: kiss_odometry, in: {scans: sensors.scans}, config: {voxel_size_m: 1.0}, run: PLACE}
  decode: {use: image_decode, in: {images: sensors.images}}
  orb: {use: orb, in: {frames: decode.frames}, config: {max_features: 2000}}
"""


def _write(path: Path) -> None:
    """Write the recording: each message of both topics, forwards and backwards."""
    with open_recording(SOURCE) as source, McapWriter(path) as writer:
        raw = [(m.channel, bytes(m.data)) for m in source.messages(topics=[SCANS, IMAGES])]
        lap = raw + raw[-3:0:-1]
        for number, (channel, data) in enumerate(lap * NUM_LAPS):
            writer.write_raw(channel, data, 10**18 + number * PERIOD_NS)


def _messages(path: Path, topics: list[str]) -> Iterator[tuple[str, Any]]:
    """Read with the `mcap` package, and decode with mapstream's decoders."""
    decoders: dict[str, Any] = {}
    with open_recording(path) as recording:
        channels = {name: topic.channel for name, topic in recording.topics.items()}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=topics):
            topic = channel.topic
            if topic not in decoders:
                decoders[topic] = decoder_for(channels[topic])
            yield (
                topic,
                decoders[topic](
                    RawMessage(
                        channel=channels[topic],
                        log_ns=message.log_time,
                        publish_ns=message.publish_time,
                        sequence=message.sequence,
                        data=memoryview(message.data),
                    )
                ),
            )


def _bare(path: Path, topics: list[str]) -> None:
    config = KISSConfig()
    config.mapping.voxel_size = 1.0
    config.registration.max_num_threads = 1
    icp = KissICP(config)
    decode, orb = ImageDecode(ImageDecodeConfig()), Orb(OrbConfig(max_features=2000))
    for topic, message in _messages(path, topics):
        if topic == SCANS:
            icp.register_frame(message.points.astype(np.float64), np.empty(0))
        else:
            orb.detect(decode.decode(message))  # type: ignore[arg-type]  # KITTI's images are whole


def _graph(text: str, path: Path, place: str) -> None:
    file = path.with_suffix(".yaml")
    file.write_text(text.replace("PATH", str(path)).replace("PLACE", place))
    report = anyio.run(run_graph, plan(load_graph(file)))
    if report.exit_code:
        raise RuntimeError(f"the graph did not run to its end: {report}")


def _median_s(*sides: Callable[[], None]) -> list[float]:
    taken: list[list[float]] = [[] for _ in sides]
    for _ in range(ROUNDS):
        for side, times in zip(sides, taken, strict=True):
            started = time.perf_counter()
            side()
            times.append(time.perf_counter() - started)
    return [statistics.median(times) for times in taken]


def run() -> list[Row]:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        _write(path)
        bare, inline, process, both, beside = _median_s(
            lambda: _bare(path, [SCANS]),
            lambda: _graph(ALONE, path, "inline"),
            lambda: _graph(ALONE, path, "process"),
            lambda: _bare(path, [SCANS, IMAGES]),
            lambda: _graph(BESIDE, path, "process"),
        )
    other = f"bare loop {bare:.2f} s"
    return [
        Row(what="KISS-ICP in a graph, inline", ours=f"{inline:.2f} s", other=other,
            ratio=inline / bare, bar="at most 1.05"),
        Row(what="KISS-ICP in a graph, its own process", ours=f"{process:.2f} s", other=other,
            ratio=process / bare, bar="at most 1.05"),
        Row(what="KISS-ICP beside image decoding and ORB", ours=f"{beside:.2f} s",
            other=f"one after another {both:.2f} s", ratio=beside / both, bar="at most 0.65"),
    ]  # fmt: skip


if __name__ == "__main__":
    print(markdown(run()))
