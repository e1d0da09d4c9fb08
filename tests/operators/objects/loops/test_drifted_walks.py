"""Drift that objects alone take out: of a real walk, and of W-RGBD."""

import pytest

from tests.data import shared
from tests.operators.objects.loops import office, table
from tests.operators.objects.loops.drifted_walk import adjusted, closed, drifted_map, judged


@pytest.mark.slow
def test_real_objects_seen_again_take_the_drift_out() -> None:
    """A walk round two desks, drifted by 3 % of its way: its objects alone close it. Images at 5 Hz are enough."""
    walk = office.walk(shared("tum_fr3_office_objects"), every=6)
    drifted = drifted_map(walk, seed=0, end_m=0.03 * walk.way_m)

    before, after = judged(drifted, walk), judged(closed(drifted, rounds=1), walk)

    assert before.end_m > 0.6
    assert after.end_m < 0.25
    assert after.ape_m < 0.4 * before.ape_m
    assert after.num_edges >= 1
    assert after.worst_edge_m < 0.5


@pytest.mark.slow
def test_J11_a_table_seen_again_takes_the_drift_out() -> None:
    """W-RGBD: half a metre of drift between the first look at the table and the last; no visual loops."""
    walk = table.walk(width_px=320)
    drifted = drifted_map(walk, seed=0, end_m=0.5, stretch=0.01)

    before = judged(drifted, walk)
    after = judged(adjusted(closed(drifted, gap_s=5.0)), walk)

    assert before.end_m > 0.49
    assert after.end_m < 0.05
    assert after.ape_m < 0.03 < before.ape_m / 3
    assert after.num_edges >= 1
