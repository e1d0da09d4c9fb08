"""Reading MCAP against decompression alone and against the `mcap` package, over one file each.

Clouds of a rotating LiDAR with noise (1 MB, 10 Hz) beside an IMU (316 B, 200 Hz), and an IMU alone.
Medians of several rounds in which both sides take turns.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.recordings.mcap_layout import from_summary
from mapstream.recordings.mcap_reader import McapRecording

ROUNDS = 5
NUM_CLOUDS, NUM_IMU = 150, 60_000


def lidar_clouds(count: int) -> list[bytes]:
    """Return scans of 65,536 points x y z intensity, whose noise compresses as that of a real sensor."""
    azimuth = np.linspace(0, 2 * np.pi, 1024)
    elevation = np.linspace(-0.4, 0.4, 64)[:, None]
    clouds = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        ranges = 8 + 3 * np.sin(3 * azimuth) + rng.normal(0, 0.02, (64, 1024))
        x = ranges * np.cos(azimuth) * np.cos(elevation)
        y = ranges * np.sin(azimuth) * np.cos(elevation)
        z = ranges * np.sin(elevation) * np.ones_like(azimuth)
        intensity = rng.integers(0, 60, (64, 1024))
        points = np.stack([x, y, z, intensity], axis=-1).round(3)
        clouds.append(points.astype("<f4").tobytes())
    return clouds


def write(path: Path, compression: CompressionType, clouds: list[bytes], num_imu: int) -> Path:
    """Write clouds at 10 Hz and IMU messages at 200 Hz, in chunks of 4 MB."""
    rng = np.random.default_rng(0)
    samples = [rng.bytes(296) + bytes(20) for _ in range(200)]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4 << 20, compression=compression)
        writer.start()
        imu = writer.register_channel("/imu", "cdr", 0)
        points = writer.register_channel("/points", "cdr", 0)
        for k in range(num_imu):
            stamp_ns = k * 5_000_000
            writer.add_message(imu, stamp_ns, samples[k % 200], stamp_ns, k)
            if k % 20 == 0 and k // 20 < len(clouds):
                writer.add_message(points, stamp_ns, clouds[k // 20], stamp_ns, k // 20)
        writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here
    return path


def decompress(path: Path) -> int:
    """Decompress all chunks in one thread; return how many bytes came out."""
    view = memoryview(path.read_bytes())
    total = 0
    for segment in from_summary(view).segments:
        data = view[segment.data_start : segment.data_start + segment.data_size]
        if segment.compression == "lz4":
            total += len(lz4.frame.decompress(data))
        else:
            total += len(zstandard.ZstdDecompressor().decompress(data))
    return total


def ours(path: Path) -> int:
    """Read all messages, checksums included."""
    with McapRecording(path) as recording:
        return sum(1 for _ in recording.messages())


def theirs(path: Path) -> int:
    """Read all messages in log-time order, as the package does by default: without checksums."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())


def _medians(path: Path, *functions: Callable[[Path], int]) -> list[float]:
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(ROUNDS):
        for function, spent in zip(functions, times, strict=True):
            started = time.perf_counter()
            function(path)
            spent.append(time.perf_counter() - started)
    return [statistics.median(spent) for spent in times]


def run() -> list[Row]:
    """Return a row for each comparison."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        clouds = lidar_clouds(NUM_CLOUDS)
        size_mb = sum(map(len, clouds)) / 1e6
        for compression, bar in ((CompressionType.ZSTD, "at most 1.3"), (CompressionType.LZ4, "")):
            path = write(Path(folder) / "mix.mcap", compression, clouds, 20 * NUM_CLOUDS)
            mine, alone, package = _medians(path, ours, decompress, theirs)
            name, speed = compression.name.lower(), f"{size_mb / mine:.0f} MB/s"
            rows += [
                Row(
                    what=f"clouds and IMU, {name}, time", ours=speed,
                    other=f"decompression alone {size_mb / alone:.0f} MB/s",
                    ratio=mine / alone, bar=bar,
                ),
                Row(
                    what=f"clouds and IMU, {name}, speed", ours=speed,
                    other=f"mcap {size_mb / package:.0f} MB/s", ratio=package / mine,
                ),
            ]  # fmt: skip
        path = write(Path(folder) / "imu.mcap", CompressionType.ZSTD, [], NUM_IMU)
        mine, package = _medians(path, ours, theirs)
        row = Row(
            what="IMU of 316 B, zstd, messages per second", ours=f"{NUM_IMU / mine / 1e3:.0f} k/s",
            other=f"mcap {NUM_IMU / package / 1e3:.0f} k/s", ratio=package / mine, bar="at least 4",
        )  # fmt: skip
        rows.append(row)
    return rows


if __name__ == "__main__":
    print(markdown(run()))
