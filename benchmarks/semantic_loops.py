"""Drift that objects seen again take out: `python benchmarks/semantic_loops.py`.

The walk of TUM RGB-D freiburg3_long_office_household round two desks, with its real detections, drifted by 3 % of the
way with ten seeds: boxes are tracked, tracks become objects, and these alone close the loops; then all that sees an
object again weighs in a bundle adjustment. Without the shared data
there are no rows. SEEDS says how many drifts there are, EVERY how many images are left out.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from tests.operators.objects.loops import office
from tests.operators.objects.loops.drifted_walk import Walk, adjusted, closed, drifted_map, judged

_DATA = Path(__file__).parents[2] / "shared" / "data" / "tum_fr3_office_objects"


def run() -> list[Row]:
    """Return a row for each drift."""
    if not _DATA.exists():
        return []
    walk = office.walk(_DATA, every=int(os.environ.get("EVERY", "3")))
    return [_row(walk, seed) for seed in range(int(os.environ.get("SEEDS", "10")))]


def _row(walk: Walk, seed: int) -> Row:
    map_ = drifted_map(walk, seed, end_m=0.03 * walk.way_m)
    started_s = time.process_time()
    loops_closed = closed(map_)
    whole = adjusted(loops_closed)
    seconds = time.process_time() - started_s
    before, between, after = (judged(each, walk) for each in (map_, loops_closed, whole))
    return Row(
        what=f"drift {seed}",
        ours=f"end {after.end_m:.3f} m, APE {after.ape_m:.3f} m ({between.end_m:.3f} and {between.ape_m:.3f} m by"
        f" edges alone), {after.num_edges} loops, the worst off by {after.worst_edge_m:.2f} m and"
        f" {np.rad2deg(after.worst_edge_rad):.0f} degrees, {seconds:.0f} s",
        other=f"end {before.end_m:.3f} m, APE {before.ape_m:.3f} m",
        ratio=after.ape_m / before.ape_m,
        bar="end below 0.25 m, APE at most 0.4",
    )


if __name__ == "__main__":
    sys.stdout.write(markdown(run()))
