"""Visual loops while a map grows."""

import numpy as np
import pytest

from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.places.visual_loops import VisualLoops, VisualLoopsConfig
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import LoopReport, MapCorrection, Submap
from tests.operators.places import made_maps, scenes

pytestmark = pytest.mark.anyio
A = "a" * 32
LAP = made_maps.LAP


@pytest.fixture(scope="module")
def two_laps() -> list[Submap]:
    truth = made_maps.circle(LAP + 6)
    flight = made_maps.flight(made_maps.room(), A, truth, {"front": scenes.camera()})
    return made_maps.in_parts(flight, 5)


async def test_H6_H20_a_lap_flown_again_closes_loops_and_says_why(two_laps: list[Submap]) -> None:
    out = await run_operator(VisualLoops(VisualLoopsConfig()), submaps=two_laps)

    reports: list[LoopReport] = out["loops"]
    edges = [edge for report in reports for edge in report.edges]
    candidates = [candidate for report in reports for candidate in report.candidates]
    truth = made_maps.circle(LAP + 6)
    assert [report.stamp_ns for report in reports] == [submap.stamp_ns for submap in two_laps]
    assert len(edges) >= 4
    assert sum(c.verdict == "accepted" for c in candidates) == len(edges)
    assert all(candidate.verdict for candidate in candidates)
    for edge in edges:
        a, b = edge.stamp_a_ns // made_maps.PERIOD_NS, edge.stamp_b_ns // made_maps.PERIOD_NS
        off = (truth[a].inverse() @ truth[b]).inverse() @ edge.T_a_b
        assert b - a >= 10
        assert edge.is_switchable
        assert (
            np.linalg.norm(off.t) < 0.2
        )  # landmarks are made of poses that drift by 0.02 m a step


async def test_loops_take_the_drift_out_of_the_map(two_laps: list[Submap]) -> None:
    found = await run_operator(VisualLoops(VisualLoopsConfig()), submaps=two_laps)

    with_loops = await run_operator(
        Optimizer(OptimizerConfig()), submaps=two_laps, loops=found["loops"]
    )
    without = await run_operator(Optimizer(OptimizerConfig()), submaps=two_laps)

    truth = made_maps.circle(LAP + 6)[-1]
    ends_m = [
        float(np.linalg.norm(out["maps"][-1].vertices.T_mission_base[-1, :3, 3] - truth.t))
        for out in (with_loops, without)
    ]
    assert ends_m[1] > 0.25
    assert ends_m[0] < 0.5 * ends_m[1]


async def test_corrected_poses_are_those_of_the_candidates(two_laps: list[Submap]) -> None:
    """The distance of a candidate is measured between corrected poses."""
    truth = made_maps.circle(LAP + 6)
    corrections = [
        MapCorrection(
            stamp_ns=submap.stamp_ns,
            mission_id=A,
            stamps_ns=np.arange(submap.stamp_ns // made_maps.PERIOD_NS + 1) * made_maps.PERIOD_NS,
            T_mission_base=np.array(
                [pose.matrix for pose in truth[: submap.stamp_ns // made_maps.PERIOD_NS + 1]]
            ),
            T_mission_odom=SE3.identity(),
        )
        for submap in two_laps
    ]

    out = await run_operator(
        VisualLoops(VisualLoopsConfig()), submaps=two_laps, corrections=corrections
    )

    last = next(c for c in out["loops"][-1].candidates if c.verdict == "accepted")
    a, b = (ns // made_maps.PERIOD_NS for ns in (last.stamp_a_ns, last.stamp_b_ns))
    assert last.distance_m == pytest.approx(np.linalg.norm(truth[a].t - truth[b].t), abs=0.08)
