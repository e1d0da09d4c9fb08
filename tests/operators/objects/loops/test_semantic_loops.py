"""Semantic loops while a map grows, and the same on the map that was stored."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.objects.landmarks.object_landmarks import (
    ObjectLandmarksConfig,
    object_landmarks,
)
from mapstream.operators.objects.loops.closing import close_semantic_loops
from mapstream.operators.objects.loops.semantic_loops import SemanticLoops, SemanticLoopsConfig
from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopReport,
    Odometry,
    RelativePose,
    Submap,
)
from tests.operators.objects.object_worlds import MISSION, Thing, around, detections
from tests.operators.places.made_maps import in_parts

pytestmark = pytest.mark.anyio
PERIOD_NS = 10**9
NUM = 8  # keyframes that see the table, then as many that do not, then as many that do
DRIFT = se3_exp(
    np.array([0.0, 0.004, 0.006, 0.02, 0.012, 0.006])
)  # of each step; the camera looks along z
SMALL = (0.12, 0.12, 0.12)
TABLE = [
    Thing("cup", (0.7, 0.4, 0.4), SMALL),
    Thing("cup", (-0.5, 0.9, 0.5), SMALL),
    Thing("book", (-0.8, -0.2, 0.3), SMALL),
    Thing("book", (0.1, -0.9, 0.2), SMALL),
    Thing("bottle", (0.2, 0.1, 0.7), SMALL),
    Thing("plant", (-0.2, -0.5, 0.9), SMALL),
    Thing("bowl", (0.9, -0.6, 0.1), SMALL),
    Thing("cup", (-1.1, 0.6, 0.1), SMALL),
]


def truth() -> list[SE3]:
    """Poses of a camera that sees a table, goes on and looks elsewhere, and sees the table again."""
    arc = [SE3(T) for T in around(NUM, turn=np.pi / 2)]
    away = [T @ SE3.from_rotation(np.diag([-1.0, 1.0, -1.0]), [0, 0, 0]) for T in arc]
    return [*arc, *reversed(away), *arc]


@pytest.fixture(scope="module")
def drive() -> Submap:
    true = truth()
    poses = [true[0]]
    for T_a, T_b in pairwise(true):
        poses.append(poses[-1] @ (T_a.inverse() @ T_b) @ SE3(DRIFT))
    features = ObjectFeatures(ObjectFeaturesConfig())
    keyframes, edges = [], []
    for k, (pose, T) in enumerate(zip(poses, true, strict=True)):
        stamp_ns = k * PERIOD_NS
        tracks = [n + 100 * (k // NUM) for n in range(len(TABLE))]
        seen = detections(T.matrix, stamp_ns, TABLE, tracks, noise_px=0.5)
        odometry = Odometry(stamp_ns=stamp_ns, T_odom_base=pose)
        found = (features.features(seen),)
        keyframes.append(Keyframe(stamp_ns=stamp_ns, odometry=odometry, features=found))
    for a, b in pairwise(keyframes):
        edges.append(
            RelativePose(
                kind="odometry",
                mission_a=MISSION,
                stamp_a_ns=a.stamp_ns,
                mission_b=MISSION,
                stamp_b_ns=b.stamp_ns,
                T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
                covariance=np.diag([1e-3] * 3 + [1e-2] * 3),
            )
        )
    return Submap(mission_id=MISSION, index=0, keyframes=tuple(keyframes), edges=tuple(edges))


def end_error_m(map_: Map) -> float:
    T = map_.vertices.T_mission_base
    return float(np.linalg.norm(T[-1, :3, 3] - truth()[-1].t))


async def test_J13_the_same_loops_are_found_live_and_in_a_stored_map(drive: Submap) -> None:
    parts = in_parts(drive, NUM)
    out = await run_operator(SemanticLoops(SemanticLoopsConfig()), submaps=parts)
    reports: list[LoopReport] = out["loops"]
    live = [edge for report in reports for edge in report.edges]
    stored, _ = object_landmarks(
        append_submap(Map.empty(), drive), ObjectLandmarksConfig(max_gap_s=10.0)
    )
    closed, report = close_semantic_loops(stored)

    assert [each.stamp_ns for each in reports] == [part.stamp_ns for part in parts]
    assert len(live) == 1
    assert live[0].is_switchable
    assert 1 <= report.num_edges <= 2
    assert all(candidate.verdict for each in reports for candidate in each.candidates)
    rows = np.flatnonzero(closed.edges.kind == "loop")
    stamps_ns = closed.vertices.stamp_ns
    ends = {
        (int(stamps_ns[closed.edges.vertex_a[r]]), int(stamps_ns[closed.edges.vertex_b[r]])): r
        for r in rows
    }
    true = truth()
    for (a_ns, b_ns), T_a_b in [
        ((live[0].stamp_a_ns, live[0].stamp_b_ns), live[0].T_a_b),
        *((key, SE3(closed.edges.T_a_b[row])) for key, row in ends.items()),
    ]:
        off = (true[a_ns // PERIOD_NS].inverse() @ true[b_ns // PERIOD_NS]).inverse() @ T_a_b
        assert np.linalg.norm(off.t) < 0.15
        assert b_ns - a_ns >= 10 * PERIOD_NS


async def test_the_optimizer_takes_the_drift_out_with_live_loops(drive: Submap) -> None:
    parts = in_parts(drive, NUM)
    found = await run_operator(SemanticLoops(SemanticLoopsConfig()), submaps=parts)

    with_loops = await run_operator(
        Optimizer(OptimizerConfig()), submaps=parts, loops=found["loops"]
    )
    without = await run_operator(Optimizer(OptimizerConfig()), submaps=parts)

    ends_m = [end_error_m(out["maps"][-1]) for out in (with_loops, without)]
    assert ends_m[1] > 0.35
    assert ends_m[0] < 0.65 * ends_m[1]
