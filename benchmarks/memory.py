"""Peak memory of mapping a recording ten times as long: `python benchmarks/memory.py`.

A short W-LID is played once and ten times over, there and back, through KISS-ICP, keyframes, submaps and the
optimizer; each run is a process of its own, with every operator in it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.worlds.catalogue import WORLDS
from mapstream.recordings.worlds.w_lid import WLidConfig
from mapstream.streams.messages.sensors import LidarScan

TIMES = 10
GRAPH = """
version: 1
name: memory
params: {recording: {type: path}, map: {type: path}}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {scans: /points}}}
  odometry: {use: kiss_odometry, in: {scans: sensors.scans}, run: inline}
  keyframes: {use: keyframes, in: {odometry: odometry.odometry, clouds: odometry.clouds}}
  submaps: {use: submap_builder, in: {keyframes: keyframes.keyframes}}
  optimizer: {use: optimizer, in: {submaps: submaps.submaps}, run: inline}
  store: {use: map_store, in: {maps: optimizer.maps, submaps: submaps.submaps}, config: {path: $map}}
"""
RUN = """
import resource, sys
from mapstream.graph.cli import main
sys.argv = ["mapstream", "run", *sys.argv[1:]]
try:
    main()
finally:
    print("PEAK", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def _scans() -> list[LidarScan]:
    config = WLidConfig(length_m=40, lidar={"beams": 16, "columns": 256})  # type: ignore[arg-type]  # pydantic makes it
    records = WORLDS["w_lid"].simulate(config, 0).records
    found = [record.message for record in records if isinstance(record.message, LidarScan)]
    return found[:150]


def _write(path: Path, scans: list[LidarScan], times: int) -> None:
    order = [
        i
        for lap in range(times)
        for i in (range(len(scans)) if lap % 2 == 0 else range(len(scans))[::-1])
    ]
    with McapWriter(path) as writer:
        for position, index in enumerate(order):
            stamp_ns = scans[0].stamp_ns + position * 100_000_000
            writer.write("/points", replace(scans[index], stamp_ns=stamp_ns), stamp_ns)


def _peak_mb(folder: Path, recording: Path) -> float:
    graph = folder / "memory.yaml"
    graph.write_text(GRAPH)
    target = folder / f"{recording.stem}_map"
    arguments = [str(graph), str(recording), "--map", str(target), "--rerun", "off"]
    done = subprocess.run(  # our own program
        [sys.executable, "-c", RUN, *arguments], capture_output=True, text=True, check=False
    )
    peaks = [line for line in done.stdout.splitlines() if line.startswith("PEAK")]
    if done.returncode not in (0, None) or not peaks:
        raise RuntimeError(done.stdout + done.stderr)
    return int(peaks[-1].split()[1]) / 1024


def run() -> list[Row]:
    """Measure the largest resident memory of the mapping process."""
    scans = _scans()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        peaks = []
        for times in (1, TIMES):
            recording = folder / f"times_{times}.mcap"
            _write(recording, scans, times)
            peaks.append(_peak_mb(folder, recording))
    return [
        Row(
            what=f"peak memory, a recording {TIMES} times as long",
            ours=f"{peaks[1]:.0f} MB",
            other=f"the short one {peaks[0]:.0f} MB",
            ratio=peaks[1] / peaks[0],
            bar="at most 1.2",
        )
    ]


if __name__ == "__main__":
    print(markdown(run()))
