"""Reports of several searches for loops become one for each submap."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.backend.loop_reports import LoopReports, LoopReportsConfig
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import LoopCandidate, LoopReport, RelativePose

pytestmark = pytest.mark.anyio
MISSION = "0f" * 16
CONFIG = LoopReportsConfig(inputs=("lidar", "objects"))


def report(stamp_ns: int, source: str, *verdicts: str) -> LoopReport:
    """A report with a candidate for each verdict, and an edge for each that is accepted."""
    edge = RelativePose(
        kind="loop",
        mission_a=MISSION,
        stamp_a_ns=0,
        mission_b=MISSION,
        stamp_b_ns=stamp_ns,
        T_a_b=SE3.identity(),
        covariance=np.eye(6),
        source=source,
    )
    candidates = [
        LoopCandidate(stamp_a_ns=0, stamp_b_ns=stamp_ns, distance_m=1.0, verdict=verdict)
        for verdict in verdicts
    ]
    edges = (edge,) * verdicts.count("accepted")
    return LoopReport(stamp_ns=stamp_ns, edges=edges, candidates=tuple(candidates))


async def test_edges_and_reasons_of_all_searches_are_kept() -> None:
    lidar = [report(10, "lidar", "too far"), report(20, "lidar", "accepted")]
    objects = [report(10, "objects"), report(20, "objects", "accepted", "ambiguous")]

    sent = await run_operator(LoopReports(CONFIG), config=CONFIG, lidar=lidar, objects=objects)

    first, second = sent["loops"]
    assert [first.stamp_ns, second.stamp_ns] == [10, 20]
    assert [c.verdict for c in first.candidates] == ["too far"]
    assert [e.source for e in second.edges] == ["lidar", "objects"]
    assert [c.verdict for c in second.candidates] == ["accepted", "accepted", "ambiguous"]


async def test_a_search_that_ends_early_is_done_without() -> None:
    lidar = [report(stamp_ns, "lidar", "accepted") for stamp_ns in (10, 20, 30)]

    sent = await run_operator(
        LoopReports(CONFIG), config=CONFIG, lidar=lidar, objects=[report(10, "objects")]
    )

    assert [len(each.edges) for each in sent["loops"]] == [1, 1, 1]
