"""The graph does not tell in which order measurements came (OmniMapper, section III-C)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mapstream.operators.trajectory.motion_models import StandingStill
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import table_digest
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import Submap
from tests.operators.trajectory.drives import MS, Message, Robot, fix, imu, odometry, wheels

WHEEL_STAMPS = range(0, 1000 * MS, 100 * MS)
VISUAL_STAMPS = [s for s in range(0, 1000 * MS, 70 * MS) if not 300 * MS < s < 500 * MS]  # a gap
IMU_STAMPS = [s + 40 * MS for s in range(0, 1000 * MS, 50 * MS)]
FIX_STAMPS = [5 * MS, 120 * MS, 260 * MS, 310 * MS, 370 * MS, 480 * MS, 730 * MS, 731 * MS]
SOURCES: list[list[Message]] = [
    [wheels(s) for s in WHEEL_STAMPS],
    [odometry(s) for s in VISUAL_STAMPS],
    [imu(s) for s in IMU_STAMPS],
]
FIXES: list[Message] = [fix(s) for s in FIX_STAMPS]
IN_ORDER: list[Message] = sorted([m for s in SOURCES for m in s] + FIXES, key=lambda m: m.stamp_ns)


def graph_of(map_: Map) -> list[bytes]:
    """Return digests of all that measurements say: stamps, edges, frames, samples."""
    tables = (map_.vertices.id, map_.vertices.stamp_ns)
    said = [t.tobytes() for t in tables]
    return said + [table_digest(t) for t in (map_.edges, map_.frames, map_.imu)]


def shuffled(
    messages: Sequence[Message], latest_ns: int, rng: np.random.Generator
) -> list[Message]:
    """Return sources in the order of stamps, and measurements up to so late after them."""
    delays = rng.integers(0, latest_ns + 1, len(messages))
    arrival = [
        m.stamp_ns + (int(delay) if isinstance(m, Constraint) else 0)
        for m, delay in zip(messages, delays, strict=True)
    ]
    return [messages[i] for i in np.lexsort((rng.random(len(messages)), np.array(arrival)))]


@pytest.fixture(scope="module")
def expected() -> Map:
    return Robot(window_ns=0).drive(IN_ORDER)


def test_the_graph_in_order_is_what_was_measured(expected: Map) -> None:
    assert check_map(expected) == []
    assert expected.vertices.stamp_ns.tolist() == FIX_STAMPS
    kinds = expected.edges.kind.tolist()
    assert kinds.count("wheel") == kinds.count("imu") == len(FIXES) - 1
    assert kinds.count("odometry") == len(FIXES) - 1 - 4  # the gap meets four intervals


def said_by(submaps: Sequence[Submap]) -> dict[tuple[object, ...], bytes]:
    """Return what submaps put into the problem, after splices: edges by kind, source and stamps."""
    said: dict[tuple[object, ...], bytes] = {}
    for submap in submaps:
        for splice in submap.splices:
            stamps = {e.stamp_a_ns for e in splice.edges} | {e.stamp_b_ns for e in splice.edges}
            ends = (min(stamps), max(stamps))
            said = {key: value for key, value in said.items() if key[2:] != ends}
        for edge in [*submap.edges, *(e for splice in submap.splices for e in splice.edges)]:
            key = (edge.kind, edge.source, edge.stamp_a_ns, edge.stamp_b_ns)
            said[key] = edge.T_a_b.matrix.tobytes() + edge.covariance.tobytes()
        for measured in [*submap.constraints, *(c for s in submap.splices for c in s.constraints)]:
            said[measured.kind, measured.source, measured.stamp_ns] = (
                measured.T_a_b.matrix.tobytes()
            )
    return said


FEW_STAMPS = (5 * MS, 120 * MS, 310 * MS, 370 * MS, 490 * MS)
FEW: list[Message] = sorted(
    [
        *(wheels(s) for s in range(0, 501 * MS, 100 * MS)),
        *(fix(s) for s in FEW_STAMPS),
    ],
    key=lambda m: m.stamp_ns,
)


@pytest.mark.slow
def test_B5_a_thousand_arrival_orders_within_the_window_give_one_graph() -> None:
    rng = np.random.default_rng(5)
    expected = said_by(few_in_order(window_ns=0).submaps)

    for _ in range(1000):
        robot = Robot(window_ns=400 * MS, has_imu=False)
        robot.hear_all(shuffled(FEW, 400 * MS, rng))
        assert said_by(robot.submaps) == expected
        assert not any(submap.splices for submap in robot.submaps)


@pytest.mark.slow
def test_B6_a_thousand_arrival_orders_with_splicing_give_one_graph() -> None:
    rng = np.random.default_rng(6)
    expected = said_by(few_in_order(window_ns=0).submaps)
    num_splices = 0

    for _ in range(1000):
        robot = Robot(window_ns=0, has_imu=False)
        robot.hear_all(shuffled(FEW, 500 * MS, rng))
        assert said_by(robot.submaps) == expected
        num_splices += sum(len(submap.splices) for submap in robot.submaps)

    assert num_splices > 1000


def few_in_order(window_ns: int) -> Robot:
    robot = Robot(window_ns=window_ns, has_imu=False)
    robot.hear_all(FEW)
    return robot


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("window_ns", [0, 400 * MS])
def test_the_map_is_the_same_for_any_arrival_order(
    expected: Map, seed: int, window_ns: int
) -> None:
    rng = np.random.default_rng(seed)

    map_ = Robot(window_ns=window_ns).drive(shuffled(IN_ORDER, 400 * MS, rng))

    assert graph_of(map_) == graph_of(expected)
    assert check_map(map_) == []
    np.testing.assert_allclose(from_first(map_), from_first(expected), atol=1e-9)


def from_first(map_: Map) -> FloatArray:
    poses = map_.vertices.T_mission_base
    return invert(poses[0]) @ poses


def test_B5_odometry_between_the_ends_counts_once(expected: Map) -> None:
    """The edges of each source span the whole interval without a gap and without an overlap."""
    edges, stamps_ns = expected.edges, expected.vertices.stamp_ns
    for kind in ("wheel", "imu"):
        rows = expected.edges_of(kind)
        lengths_ns = stamps_ns[edges.vertex_b[rows]] - stamps_ns[edges.vertex_a[rows]]
        assert lengths_ns.sum() == stamps_ns[-1] - stamps_ns[0]
        assert (lengths_ns > 0).all()


def test_B6_a_bridge_that_a_late_measurement_makes_needless_goes() -> None:
    """Wheels measured the first half and visual odometry the second: only together do they link."""
    first = [wheels(s * MS) for s in range(0, 501, 100)]
    second = [odometry(s * MS) for s in range(500, 1001, 100)]
    ends, middle = [fix(0), fix(900 * MS)], fix(500 * MS)

    bridged = Robot(window_ns=0, bridge=StandingStill())
    bridged.drive([*first, ends[0], *second, ends[1]])
    before = bridged.map().edges.kind.tolist()
    bridged.builder.add(middle)
    spliced = bridged.drive([])

    assert "motion_model" in before
    assert "motion_model" not in spliced.edges.kind
    assert sorted(spliced.edges.kind.tolist()) == ["odometry", *["position"] * 3, "wheel"]
