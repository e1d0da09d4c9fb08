"""LiDAR odometry in a graph against the same library in a bare loop: `python benchmarks/odometry.py`.

The recording is the 16 scans and images of `kitti_camera_lidar` driven forwards and backwards, so that it
lasts and nothing jumps. The bare loop reads with the `mcap` package and calls the same decoders, KISS-ICP
with the same settings and one thread, and for the second row OpenCV's decoder and ORB, one after another.
Both sides take turns; the figures are medians, starting of processes included.
The last rows are of ten seconds of W-LID with spins, operators called as functions: KISS-ICP's own class, fed by
hand as its `OdometryPipeline` does, against the operator, and against LiDAR-inertial odometry, in time and in error.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import takewhile
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
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.odometry.lidar_inertial.lidar_inertial_odometry import (
    LidarInertialOdometry,
    LidarInertialOdometryConfig,
)
from mapstream.operators.trajectory.config import ImuConfig
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.evaluation import ape
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.recordings.recording import RawMessage, open_recording
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.w_lid import START_NS, WLidConfig, drive, w_lid
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan

ROUNDS = 3
NUM_LAPS = 8  # there and back
PERIOD_NS = 50_000_000
SPINS_NS = 10_000_000_000
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


def _spins() -> tuple[list[LidarScan], list[ImuBatch], Motion]:
    """Return ten seconds of W-LID with spins, and the true motion."""
    world = WLidConfig(length_m=60.0, aggressive=True)
    records = takewhile(lambda r: r.log_ns <= START_NS + SPINS_NS, w_lid(world, 0).records)
    messages = [record.message for record in records]
    scans = [message for message in messages if isinstance(message, LidarScan)]
    imu = [message for message in messages if isinstance(message, ImuBatch)]
    return scans, imu, drive(Ring(world.length_m), world)


def _kiss_itself(scans: list[LidarScan]) -> list[np.ndarray[Any, Any]]:
    """Return T_odom_sensor of each scan, by KISS-ICP as its pipeline runs it."""
    config = KISSConfig()
    config.mapping.voxel_size = 0.5  # what the operator takes for these ranges
    config.registration.max_num_threads = 1
    icp, poses = KissICP(config), []
    for scan in scans:
        assert scan.offsets_ns is not None
        icp.register_frame(scan.points.astype(np.float64), scan.offsets_ns.astype(np.float64))
        poses.append(icp.last_pose)
    return poses


def _inertial(scans: list[LidarScan], imu: list[ImuBatch]) -> list[Odometry]:
    quiet = ImuConfig(gyro_density=1.7e-4, accel_density=2e-3)
    operator = LidarInertialOdometry(LidarInertialOdometryConfig(imu=quiet))
    for batch in imu:
        operator.add_imu(batch)
    return [odometry for scan in scans for odometry, _ in operator.track(scan)]


def _error_m(poses: list[np.ndarray[Any, Any]], scans: list[LidarScan], motion: Motion) -> float:
    stamps_ns = np.array([scan.end_ns for scan in scans])
    truth = motion.poses(stamps_ns)
    pairs = PosePairs(stamps_ns=stamps_ns, estimate=np.array(poses), reference=truth)
    return float(ape(pairs).translation.rmse)


def _rows_of_spins() -> list[Row]:
    scans, imu, motion = _spins()
    operator: list[Odometry] = []
    inertial: list[Odometry] = []
    itself: list[np.ndarray[Any, Any]] = []

    def wrapped() -> None:
        kiss = KissOdometry(KissOdometryConfig(voxel_size_m=0.5))
        operator[:] = [kiss.register(scan).odometry for scan in scans]

    def own() -> None:
        itself[:] = _kiss_itself(scans)

    def with_imu() -> None:
        inertial[:] = _inertial(scans, imu)

    own_s, wrapped_s, inertial_s = (each / len(scans) for each in _median_s(own, wrapped, with_imu))
    T_sensor_base = scans[0].T_base_sensor.inverse().matrix
    error_m = _error_m([T @ T_sensor_base for T in itself], scans, motion)
    found_m = _error_m([each.T_odom_base.matrix for each in inertial], scans, motion)
    other = f"kiss_icp itself {own_s * 1e3:.1f} ms"
    return [
        Row(what="KISS-ICP operator, a scan", ours=f"{wrapped_s * 1e3:.1f} ms", other=other,
            ratio=wrapped_s / own_s, bar="at most 1.25"),
        Row(what="LiDAR-inertial odometry, a scan", ours=f"{inertial_s * 1e3:.1f} ms", other=other,
            ratio=inertial_s / own_s),
        Row(what="LiDAR-inertial odometry, error where it spins", ours=f"{found_m * 1e3:.1f} mm",
            other=f"kiss_icp itself {error_m * 1e3:.1f} mm", ratio=found_m / error_m, bar="at most 0.5"),
    ]  # fmt: skip


def run() -> list[Row]:
    cv2.setNumThreads(1)
    return [*_rows_of_graphs(), *_rows_of_spins()]


def _rows_of_graphs() -> list[Row]:
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
