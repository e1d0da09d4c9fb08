"""How long synthetic worlds take to be made, whole and with their defaults: `python benchmarks/worlds.py`."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.recordings.worlds.catalogue import WORLDS

LIMIT_S = 60.0
CORES = 2
RUN = "import sys; from mapstream.graph.cli import main; main()"


def made(world: str, folder: Path) -> Row:
    """Return the time of one world; its processor time is what another machine's load cannot change."""
    path = folder / f"{world}.mcap"
    before, start = os.times(), time.perf_counter()
    command = [sys.executable, "-c", RUN, "simulate", world, str(path)]
    subprocess.run(command, check=True, capture_output=True)
    wall_s = time.perf_counter() - start
    after = os.times()
    processor_s = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    row = Row(
        what=f"`simulate {world}`, {path.stat().st_size / 1e6:.0f} MB",
        ours=f"{wall_s:.0f} s, {processor_s:.0f} s of processor time",
        other=f"{LIMIT_S:.0f} s on {CORES} cores",
        ratio=processor_s / CORES / LIMIT_S,
        bar="at most 1",
    )
    path.unlink()
    return row


def run() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        return [made(world, Path(folder)) for world in WORLDS]


if __name__ == "__main__":
    print(markdown(run()))
