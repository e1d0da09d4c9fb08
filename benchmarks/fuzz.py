"""Eight robots send a hundred thousand factors to one optimizer, in disorder and some of them false."""

from __future__ import annotations

import time

import anyio
import numpy as np

from benchmarks.table import Row, markdown
from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.recordings.maps import check_map
from tests.operators.estimation.fuzz import Traffic, run_traffic

TRAFFIC = Traffic(num_submaps=10, submap=50, num_sources=25, loop_every=8)


def run() -> list[Row]:
    """Send it all, check the map, and compare with the batch solver on the map that came of it."""
    started = time.perf_counter()
    outcome = anyio.run(run_traffic, TRAFFIC)
    live_s = time.perf_counter() - started
    edges = outcome.map.edges
    num_missing = TRAFFIC.num_edges + outcome.num_loops - len(edges)
    num_broken = len(check_map(outcome.map)) + int((~np.isfinite(edges.switch)).sum())
    started = time.perf_counter()
    optimize_map(outcome.map, OptimizeConfig())
    batch_s = time.perf_counter() - started
    return [
        Row(what=f"{len(edges)} factors of {TRAFFIC.num_robots} robots, live", ours=f"{live_s:.0f} s", other=f"one batch {batch_s:.0f} s", ratio=live_s / batch_s),
        Row(what="factors lost, rules broken", ours=f"{num_missing}, {num_broken}", other="none", ratio=num_missing + num_broken, bar="0"),
    ]  # fmt: skip


if __name__ == "__main__":
    print(markdown(run()))
