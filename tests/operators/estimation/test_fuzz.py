"""One owner of the problem, many producers: whatever the order and however bad the loops, it ends with a map."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.estimation.states import initial_values, with_solution
from mapstream.recordings.maps import check_map
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.combine import merge_maps
from tests.operators.estimation.fuzz import Traffic, run_traffic
from tests.recordings.made_maps import OTHER_MISSION, line_map


@pytest.mark.slow
@pytest.mark.anyio
async def test_U19_eight_producers_and_bad_loops_crash_nothing() -> None:
    """`benchmarks/fuzz.py` sends a hundred thousand factors."""
    traffic = Traffic()

    outcome = await run_traffic(traffic)

    assert outcome.num_corrections == traffic.num_robots * traffic.num_submaps
    assert len(outcome.map.missions) == traffic.num_robots
    edges = outcome.map.edges
    assert len(outcome.map.edges_of("odometry")) == traffic.num_edges
    assert len(outcome.map.edges_of("loop")) == outcome.num_loops > 0
    assert np.isfinite(outcome.map.vertices.T_mission_base).all()
    assert ((edges.switch >= 0) & (edges.switch <= 1)).all()
    assert check_map(outcome.map) == []


def test_poses_stay_rotations_however_often_a_solution_goes_in_and_out() -> None:
    """Errors of rounding grew by 2.7 with each turn: 1e-12 was 1e-2 after some fifteen submaps."""
    map_ = merge_maps([line_map(3), line_map(3, OTHER_MISSION)])
    rounded = map_.vertices.T_mission_base.copy()
    rounded[:, :3, :3] += np.random.default_rng(0).normal(size=(6, 3, 3)) * 1e-12
    map_ = with_poses(map_, np.arange(6), rounded)

    for _ in range(30):
        map_ = with_solution(map_, initial_values(map_, range(6)))

    assert check_map(map_) == []
    R = map_.vertices.T_mission_base[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)
