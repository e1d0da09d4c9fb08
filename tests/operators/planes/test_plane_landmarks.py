"""Which plane is seen again: angle, distance, overlap; several sensors; drift; corrections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapstream.operators.planes.plane_landmarks import PlaneLandmarks, PlaneLandmarksConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.hulls import hull_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import MapCorrection, Odometry
from mapstream.streams.messages.planes import PlaneSegments

pytestmark = pytest.mark.anyio

INF = np.inf
PLANE = np.diag([1e-5, 1e-5, INF, INF, INF, 1e-5])
LINE = np.diag([INF, 1e-5, INF, INF, INF, 1e-5])
SECOND_NS = 10**9
SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
WALL = SE3.from_rotation(
    np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), [4.0, 0.0, 1.2]
)  # faces -x
LOW = SE3.from_rotation(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), [4.0, 0.2, 0.3])
ENDS = np.array([[-1.0, 0.0], [1.0, 0.0]])


def table(x: float, y: float, height: float = 0.7, turn: Sequence[float] = (0, 0, 0)) -> SE3:
    return SE3.from_rotation(so3_exp(turn), [x, y, height])


def seen(
    at_s: float,
    *planes: SE3,
    T_world_base: SE3 | None = None,
    hulls: Sequence[FloatArray] = (),
    covariance: FloatArray = PLANE,
    frame: str = "camera",
) -> PlaneSegments:
    T_base_world = (T_world_base or SE3.identity()).inverse()
    n = len(planes)
    return PlaneSegments(
        stamp_ns=round(at_s * SECOND_NS),
        T_base_plane=np.array([(T_base_world @ plane).matrix for plane in planes]).reshape(
            -1, 4, 4
        ),
        covariances=np.tile(covariance, (n, 1, 1)),
        hulls_m=tuple(hulls) or (SQUARE,) * n,
        num_points=np.full(n, 10_000),
        rmse_m=np.zeros(n),
        frame=frame,
    )


def moves(until_s: int, *, speed_mps: float = 0.0) -> list[Odometry]:
    return [
        Odometry(
            stamp_ns=s * SECOND_NS, T_odom_base=SE3.from_rotation(np.eye(3), [speed_mps * s, 0, 0])
        )
        for s in range(until_s + 1)
    ]


async def names(
    *messages: PlaneSegments,
    config: dict[str, Any] | None = None,
    odometry: Sequence[Odometry] = (),
) -> list[str]:
    made = await measured(*messages, config=config, odometry=odometry)
    order = list(dict.fromkeys(c.landmark.name for c in made if c.landmark))
    return [chr(ord("A") + order.index(c.landmark.name)) for c in made if c.landmark]


async def measured(
    *messages: PlaneSegments,
    config: dict[str, Any] | None = None,
    odometry: Sequence[Odometry] = (),
) -> list[Constraint]:
    chosen = PlaneLandmarksConfig.model_validate(config or {})
    out = await run_operator(
        PlaneLandmarks(chosen), config=chosen, planes=messages, odometry=odometry or moves(10)
    )
    constraints: list[Constraint] = out["constraints"]
    return constraints


async def test_N3_two_tables_of_one_height_stay_two() -> None:
    """Their outlines do not overlap; each is seen again where it is."""
    left, right = table(2, 0.8), table(2, -0.8)

    assert await names(seen(1, left, right), seen(2, right), seen(3, left), seen(4, left, right)) == [
        *"AB", "B", "A", *"AB",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("again", "expected"),
    [
        (table(2, 0.5, 0.8), "AA"),  # 0.1 m higher
        (table(2, 0.5, 1.35), "AB"),  # 0.65 m
        (table(2, 0.5, turn=(np.deg2rad(8), 0, 0)), "AA"),
        (table(2, 0.5, turn=(np.deg2rad(12), 0, 0)), "AB"),
        (table(2.9, 0.5), "AA"),  # a tenth of it overlaps
        (table(3.1, 0.5), "AB"),
        (table(2, 0.5, turn=(np.pi, 0, 0)), "AB"),  # seen from below
    ],
)
async def test_N3_angle_distance_and_overlap_decide(again: SE3, expected: str) -> None:
    found = await names(
        seen(1, table(2, 0.5)), seen(2, again), config={"at_once": 1.0, "min_overlap": 0.05}
    )

    assert found == list(expected)


async def test_N3_the_outline_grows_as_more_is_seen() -> None:
    """A floor seen bit by bit, each bit overlapping what is known, is one plane as long as all of them."""
    bits = [seen(1 + k, table(2 + 0.8 * k, 0, 0.0)) for k in range(6)]
    operator = PlaneLandmarks(PlaneLandmarksConfig())

    await run_operator(operator, config=PlaneLandmarksConfig(), planes=bits, odometry=moves(10))

    (known,) = operator.known.planes
    assert np.ptp(known.plane.hull_m, axis=0) == pytest.approx([5.0, 1.0], abs=0.02)


async def test_N3_pieces_of_one_floor_become_one_once_a_piece_lies_on_both() -> None:
    """The older name stays; what shows that they are one measures both, so that they are one in the map, too."""
    left, right, between = table(2, 1.0, 0.0), table(2, -1.0, 0.0), table(2, 0.0, 0.0)
    wide = SQUARE * [1.0, 1.5]
    operator = PlaneLandmarks(PlaneLandmarksConfig())

    out = await run_operator(
        operator,
        config=PlaneLandmarksConfig(),
        planes=[seen(1, left), seen(2, right), seen(3, between, hulls=[wide]), seen(4, right)],
        odometry=moves(10),
    )

    first, second = "plane:1000000000:0", "plane:2000000000:0"
    named = [(c.stamp_ns // SECOND_NS, c.landmark.name) for c in out["constraints"]]
    assert named == [(1, first), (2, second), (3, first), (3, second), (4, first)]
    (known,) = operator.known.planes
    assert np.ptp(known.plane.hull_m, axis=0) == pytest.approx([1.0, 3.0], abs=0.02)


async def test_N3_pieces_that_were_seen_above_each_other_never_become_one() -> None:
    """A board before a wall is another plane after a long way, too, when both are within reach."""
    board, wall = table(2, 0, 0.12), table(2, 0.1, 0.0)

    found = await names(
        seen(0, board, wall),
        seen(9, wall, T_world_base=SE3.from_rotation(np.eye(3), [9.0, 0, 0])),
        seen(10, board, wall, T_world_base=SE3.from_rotation(np.eye(3), [10.0, 0, 0])),
        odometry=moves(10, speed_mps=1.0),
    )

    assert found == ["A", "B", "B", "A", "B"]


async def test_N3_what_lies_on_a_table_is_not_the_table() -> None:
    """Within reach of the table, but beside it in the same image."""
    board, box = table(2, 0), table(2.1, 0, 0.95)

    found = await names(
        seen(1, board), seen(2, board, box), seen(3, box, board), config={"at_once": 1.0}
    )

    assert found == ["A", "A", "B", "B", "A"]


async def test_N3_a_plane_may_be_further_off_after_a_long_way() -> None:
    """Odometry drifts: 0.5 m are nothing after ten metres, and another plane after none."""
    far = {"at_once": 0.3, "full_after_m": 5.0}

    at_once = await names(seen(1, table(2, 0)), seen(2, table(2, 0, 1.2)), config=far)
    base = SE3.from_rotation(np.eye(3), [10.0, 0, 0])
    later = await names(
        seen(0, table(2, 0)),
        seen(10, table(2, 0, 1.2), T_world_base=base),
        config=far,
        odometry=moves(10, speed_mps=1.0),
    )

    assert at_once == ["A", "B"]
    assert later == ["A", "A"]


async def test_E14_measurements_name_the_plane_and_carry_its_outline() -> None:
    (made,) = await measured(seen(1.5, table(2, 0)))

    assert made.kind == "plane"
    assert made.landmark is not None
    assert (made.landmark.kind, made.landmark.name) == ("plane", "plane:1500000000:0")
    np.testing.assert_allclose(made.T_a_b.matrix, table(2, 0).matrix, atol=1e-12)
    np.testing.assert_array_equal(made.covariance, PLANE)
    np.testing.assert_allclose(hull_of(made.payload), SQUARE)


@pytest.mark.parametrize("first", ["laser", "camera"])
async def test_N5_a_lasers_wall_line_and_a_cameras_wall_are_one(first: str) -> None:
    """The line runs below all that the camera saw; whichever sensor comes first, the wall is one."""
    camera = seen(1.0 if first == "camera" else 2.0, WALL)
    laser = seen(
        2.0 if first == "camera" else 1.0, LOW, hulls=[ENDS], covariance=LINE, frame="laser"
    )
    both = PlaneLandmarksConfig(inputs=("camera", "laser"))
    operator = PlaneLandmarks(both)

    out = await run_operator(
        operator,
        config=both,
        camera=[camera, replace(camera, stamp_ns=3 * SECOND_NS)],
        laser=[laser, replace(laser, stamp_ns=4 * SECOND_NS)],
        odometry=moves(6),
    )

    assert len({constraint.landmark.name for constraint in out["constraints"]}) == 1
    (known,) = operator.known.planes
    assert not known.plane.is_line
    corners = known.plane.hull_m @ known.plane.T_frame_plane[:3, :2].T + known.plane.origin
    assert np.ptp(corners, axis=0) == pytest.approx([0, 2.0, 1.4], abs=0.02)


async def test_N5_a_line_on_the_floor_is_no_floor() -> None:
    """The floor holds every level line near it, but faces another way."""
    both = {"inputs": ("planes",), "at_once": 1.0}
    floor, line = table(4, 0, 0.0), LOW

    found = await names(seen(1, floor), seen(2, line, hulls=[ENDS], covariance=LINE), config=both)

    assert found == ["A", "B"]


async def test_N5_lines_of_a_laser_alone_join() -> None:
    """Two parts of one wall that overlap are one line, as long as both."""
    along = LOW @ SE3.from_rotation(np.eye(3), [1.5, 0, 0])
    operator = PlaneLandmarks(PlaneLandmarksConfig())

    await run_operator(
        operator,
        config=PlaneLandmarksConfig(),
        planes=[
            seen(1, LOW, hulls=[ENDS], covariance=LINE),
            seen(2, along, hulls=[ENDS], covariance=LINE),
        ],
        odometry=moves(4),
    )

    (known,) = operator.known.planes
    assert known.plane.is_line
    assert known.plane.hull_m.shape == (2, 2)
    assert np.ptp(known.plane.hull_m[:, 0]) == pytest.approx(3.5)


async def test_N3_corrections_move_what_is_known_at_a_stamp_not_on_arrival() -> None:
    """Odometry drifts sideways by 2 m; a correction of stamp 1 s counts 3 s later and not before."""
    drift = SE3.from_rotation(np.eye(3), [0, 2.0, 0])
    odometry = [Odometry(stamp_ns=0, T_odom_base=SE3.identity())] + [
        Odometry(stamp_ns=s * SECOND_NS, T_odom_base=drift) for s in range(1, 9)
    ]
    corrections = [
        MapCorrection(
            stamp_ns=s * SECOND_NS,
            mission_id="ab" * 16,
            stamps_ns=np.arange(s + 1) * SECOND_NS,
            T_mission_base=np.tile(np.eye(4), (s + 1, 1, 1)),
            T_mission_odom=drift.inverse(),
        )
        for s in (1, 4, 7)
    ]
    config = PlaneLandmarksConfig(feedback_s=3.0)
    spots = [seen(s, table(2, 0)) for s in range(9)]

    out = await run_operator(
        PlaneLandmarks(config),
        config=config,
        planes=spots,
        odometry=odometry,
        corrections=corrections,
    )

    found = [constraint.landmark.name for constraint in out["constraints"]]
    first, second = f"plane:{0}:0", f"plane:{SECOND_NS}:0"
    assert found[:4] == [first, second, second, second]
    assert set(found[4:]) <= {first, second}  # both lie in one place now


async def test_planes_beyond_the_odometry_are_counted() -> None:
    assert await measured(seen(20, table(2, 0))) == []
