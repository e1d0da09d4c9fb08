"""Drift that objects alone take out: of a real walk, and of W-RGBD."""

import pytest

from tests.data import shared
from tests.operators.objects.loops import office
from tests.operators.objects.loops.drifted_walk import closed, drifted_map, judged


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
