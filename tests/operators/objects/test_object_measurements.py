"""Recognised objects as measurements: which factor, which landmark, and loops that they close."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.maps.merge import merge
from mapstream.operators.objects.object_measurements import (
    ObjectMeasurements,
    ObjectMeasurementsConfig,
)
from mapstream.operators.objects.recognition import Gate, KnownObjects, SeenObject
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import MapCorrection, Odometry
from mapstream.streams.messages.objects import ObjectDetections
from tests.operators.estimation.problems import factors_of
from tests.operators.objects.made_detections import detections

pytestmark = pytest.mark.anyio
SECOND_NS = 10**9
T_base_camera = SE3.from_rotation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.0, 0.5])


def seen(
    at_s: float,
    *places: Sequence[float],
    T_world_base: SE3 | None = None,
    **more: Any,  # noqa: ANN401  # fields of the message
) -> ObjectDetections:
    """Things at these places in the world, each in a box in the middle of the image."""
    T_camera_world = ((T_world_base or SE3.identity()) @ T_base_camera).inverse()
    centers = np.array([T_camera_world @ np.array(place, float) for place in places])
    return detections(
        [(20, 10, 40, 30)] * len(places),
        round(at_s * SECOND_NS),
        centers_m=centers.reshape(-1, 3),
        T_base_sensor=T_base_camera,
        **{"track_ids": None} | more,
    )


def still(until_s: int = 10) -> list[Odometry]:
    return [
        Odometry(stamp_ns=s * SECOND_NS, T_odom_base=SE3.identity()) for s in range(until_s + 1)
    ]


async def measured(
    *messages: ObjectDetections,
    odometry: Sequence[Odometry] = (),
    **options: Any,  # noqa: ANN401  # of the config
) -> list[Constraint]:
    config = ObjectMeasurementsConfig.model_validate(options)
    out = await run_operator(
        ObjectMeasurements(config), config=config, detections=messages, odometry=odometry or still()
    )
    constraints: list[Constraint] = out["constraints"]
    return constraints


async def names(*messages: ObjectDetections, **options: Any) -> str:  # noqa: ANN401  # as `measured`
    """Which thing each measurement is of: A, B ... in the order in which they appear."""
    made = [c.landmark.name for c in await measured(*messages, **options) if c.landmark]
    order = list(dict.fromkeys(made))
    return "".join(chr(ord("A") + order.index(name)) for name in made)


async def mapped(
    constraints: Sequence[Constraint], odometry: Sequence[Odometry], mission: str = ""
) -> Map:
    config = TrajectoryConfig.model_validate(
        {
            "sources": {"odometry": {"kind": "odometry"}},
            "constraints": {"objects": {}},
            "mission": mission,
        }
    )
    out = await run_operator(
        Trajectory(config), config=config, odometry=odometry, objects=constraints
    )
    map_ = Map.empty()
    for submap in out["submaps"]:
        map_ = append_submap(map_, submap)
    return map_


@pytest.mark.parametrize("is_oriented", [True, False])
async def test_N7_the_factor_is_of_a_pose_with_orientation_and_of_a_point_without(
    is_oriented: bool,  # noqa: FBT001
) -> None:
    quat = [[0.5, -0.5, 0.5, -0.5]] if is_oriented else [[np.nan] * 4]
    sign = seen(1, (4, 0, 1.5), quats_camera_object_xyzw=np.array(quat), extents_m=np.ones((1, 3)))

    map_ = await mapped(await measured(sign), still())

    assert check_map(map_) == []
    (row,) = np.flatnonzero(map_.edges.kind == "landmark").tolist()
    dimension = 6 if is_oriented else 3
    assert factors_of(map_)[row].dim() == dimension
    assert map_.landmarks.kind.tolist() == ["pose" if is_oriented else "object"]
    place = map_.T_map_landmark(np.array([0]))[0]
    np.testing.assert_allclose(place[:3, 3], [4, 0, 1.5], atol=1e-6)
    assert np.isfinite(map_.landmarks.quat_base_xyzw).all() == is_oriented
    assert object_payload(map_.landmarks, 0) == {"extent_m": [1.0, 1.0, 1.0]}


async def test_N7_a_thing_stays_what_it_was_when_it_was_seen_first() -> None:
    """A sign with an orientation that is seen without one later gives a factor on its place alone."""
    quats = np.array([[0.5, -0.5, 0.5, -0.5]])
    first = seen(1, (4, 0, 1.5), texts=("EXIT 12",), quats_camera_object_xyzw=quats)
    later = seen(2, (4, 0, 1.5), texts=("EXIT 12",))

    map_ = await mapped(await measured(first, later), still())

    rows = np.flatnonzero(map_.edges.kind == "landmark")
    assert map_.landmarks.kind.tolist() == ["pose"]
    assert [factors_of(map_)[row].dim() for row in rows.tolist()] == [6, 3]
    assert object_payload(map_.landmarks, 0) == {"text": "EXIT 12"}


@pytest.mark.parametrize(
    ("again", "options", "expected"),
    [
        ((4, 0.2, 1), {}, "AA"),
        ((4, 0.4, 1), {}, "AB"),
        ((4, 0.4, 1), {"gate_m": 0.5}, "AA"),
        ((4, 0.2, 1), {"labels": ["chair"]}, ""),
        ((4, 0.2, 1), {"by_place": False}, ""),
    ],
)
async def test_N8_without_a_text_class_and_place_decide(
    again: Sequence[float], options: dict[str, Any], expected: str
) -> None:
    assert await names(seen(1, (4, 0, 1)), seen(2, again), **options) == expected


_THING = st.tuples(
    st.floats(-1, 1),
    st.sampled_from(["cup", "chair"]),
    st.sampled_from(["", "12", "13"]),
    st.integers(-1, 3),
)  # place, class, text, track


@given(st.lists(st.lists(_THING, max_size=4), max_size=5))
def test_N8_what_is_seen_at_once_is_never_one_thing(
    moments: list[list[tuple[float, str, str, int]]],
) -> None:
    """Whatever texts and tracks say; of things that are known, classes stay, unless a text says otherwise."""
    gate = Gate(at_once_m=0.5, per_m=0.1, most_m=2.0, ambiguity=1.5)
    known = KnownObjects(gate, "object")
    for stamp_ns, moment in enumerate(moments):
        before = {each.name: each.label for each in known.objects}
        objects = [
            SeenObject(
                label=label,
                p_frame=np.array([x, 0, 0]),
                text=text,
                track=None if track < 0 else ("camera", track),
            )
            for x, label, text, track in moment
        ]

        found = known.see(stamp_ns, objects, np.eye(4), float(stamp_ns))

        names = [same[0].name for same in found if same]
        assert len(names) == len(set(names))
        for seen_object, same in zip(objects, found, strict=True):
            if same and not seen_object.text and seen_object.track is None:
                assert before.get(same[0].name, seen_object.label) == seen_object.label


async def test_N8_classes_never_meet() -> None:
    assert await names(seen(1, (4, 0, 1)), seen(2, (4, 0, 1), labels=("chair",))) == "AB"


async def test_N8_what_may_be_one_of_two_measures_neither() -> None:
    """A cup 12 cm from one and 10 cm from the other; two cups as near to one that is known."""
    two = seen(1, (4, 0, 1), (4, 0.22, 1))

    assert await names(two, seen(2, (4, 0.12, 1)), seen(3, (4, 0.02, 1))) == "ABA"
    assert await names(seen(1, (4, 0, 1)), seen(2, (4, 0.1, 1), (4, -0.12, 1))) == "A"
    assert await names(two, seen(2, (4, 0.21, 1), (4, 0.02, 1))) == "ABBA"


async def test_N8_a_track_stays_one_thing_however_far_it_jumps() -> None:
    track: dict[str, Any] = {"track_ids": np.array([3])}

    assert await names(seen(1, (4, 0, 1), **track), seen(2, (4, 1, 1), **track)) == "AA"


async def test_N8_the_gate_grows_with_the_way() -> None:
    way = [
        Odometry(stamp_ns=s * SECOND_NS, T_odom_base=SE3.exp([0, 0, 0, 2.0 * (s % 5), 0, 0]))
        for s in range(11)
    ]
    moved = [seen(0, (4, 0, 1)), seen(10, (4, 0.6, 1))]

    assert await names(*moved, odometry=way, gate_per_m=0.0) == "AB"
    assert await names(*moved, odometry=way, gate_per_m=0.03) == "AA"


async def test_N8_a_text_is_known_anywhere_and_nowhere_if_two_show_it() -> None:
    exits: dict[str, Any] = {"texts": ("EXIT",)}

    assert await names(seen(1, (4, 0, 1), **exits), seen(2, (9, 3, 1), **exits)) == "AA"
    twice = seen(1, (4, 0, 1), (4, 3, 1), texts=("EXIT", "EXIT"))
    assert await names(twice, seen(2, (9, 3, 1), **exits)) == "ABC"


async def test_N8_what_shows_its_text_at_last_measures_both() -> None:
    """From afar a sign has no name; its track tells that it is the one that can be read now."""
    track: dict[str, Any] = {"track_ids": np.array([3])}
    far, near = seen(1, (4, 0, 1), **track), seen(2, (4, 0, 1), texts=("12",), **track)

    assert await names(far, near, seen(3, (4, 0, 1), texts=("12",))) == "ABAB"


@pytest.mark.parametrize(("num_cups", "expected"), [(1, "ABBBABAAAA"), (2, "ABCDCDCDACBDABABABAB")])
async def test_N8_what_a_correction_brings_together_is_one_thing_unless_it_was_seen_at_once(
    num_cups: int, expected: str
) -> None:
    """Odometry jumps by 2 m; what the optimizer makes of stamp 1 s counts 3 s later, for stamps as they were."""
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
    cups = [(4.0, 0.1 * k, 1.0) for k in range(num_cups)]
    config = ObjectMeasurementsConfig(feedback_s=3.0)
    operator = ObjectMeasurements(config)

    out = await run_operator(
        operator,
        config=config,
        detections=[seen(s, *cups) for s in range(9)],
        odometry=odometry,
        corrections=corrections,
    )

    found = [constraint.landmark.name for constraint in out["constraints"]]
    order = list(dict.fromkeys(found))
    assert "".join(chr(ord("A") + order.index(name)) for name in found) == expected
    assert len(operator.known.objects) == num_cups


def round_trip(drift_radps: float) -> tuple[list[SE3], list[Odometry]]:
    """A robot that drives once around a square of 10 m, and what a gyroscope with a bias makes of it."""
    truth, drifting, odometry = SE3.identity(), SE3.identity(), list[Odometry]()
    poses = list[SE3]()
    for s in range(41):
        poses.append(truth)
        sigmas = np.array([1e-4, 1e-4, 0.01, 0.01, 0.01, 1e-4])
        odometry.append(
            Odometry(
                stamp_ns=s * SECOND_NS, T_odom_base=drifting, covariance=np.diag(np.square(sigmas))
            )
        )
        step = np.array([0, 0, np.pi / 2 * (s % 10 == 9), 1.0, 0, 0])
        truth = truth @ SE3.exp([0, 0, 0, *step[3:]]) @ SE3.exp([*step[:3], 0, 0, 0])
        turn = SE3.exp([0, 0, step[2] + drift_radps, 0, 0, 0])
        drifting = drifting @ SE3.exp([0, 0, 0, *step[3:]]) @ turn
    return poses, odometry


@pytest.mark.parametrize(
    ("known_by", "limit_m"), [("text", 0.05), ("text without orientation", 0.7), ("class", 0.05)]
)
async def test_N8_a_sign_seen_twice_pulls_a_drifting_trajectory_straight(
    known_by: str, limit_m: float
) -> None:
    """After 40 m odometry is 2.2 m off; the sign at the start is seen again. A point leaves the heading open."""
    poses, odometry = round_trip(drift_radps=0.008)
    sign = SE3.from_rotation(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), [4.0, 1.0, 1.5])
    signs = []
    for s in (0, 1, 39, 40):
        T_camera_sign = (poses[s] @ T_base_camera).inverse() @ sign
        quats = None if "without" in known_by else T_camera_sign.quat_xyzw[None]
        more: dict[str, Any] = {"texts": ("EXIT 12",)} if "text" in known_by else {}
        signs.append(
            seen(s, sign.t.tolist(), T_world_base=poses[s], quats_camera_object_xyzw=quats, **more)
        )
    sure = {"rotation_sigma_rad": 0.01, "center_share": 0.0}
    gate = {"gate_per_m": 0.1, "most_gate_m": 5.0}

    constraints = await measured(*signs, odometry=odometry, **sure, **gate)
    solved, _ = optimize_map(await mapped(constraints, odometry))

    assert check_map(solved) == []
    assert len(solved.landmarks) == 1
    ends = solved.vertices.T_mission_base[[0, -1]]
    error_m = float(np.linalg.norm((np.linalg.inv(ends[0]) @ ends[1])[:3, 3] - poses[-1].t))
    drift_m = float(np.linalg.norm(odometry[-1].T_odom_base.t - poses[-1].t))
    assert drift_m > 2.0
    assert error_m < limit_m


async def test_N8_a_sign_that_two_robots_read_puts_their_maps_together() -> None:
    """The second robot begins 3 m aside, turned; its map does not know that until both are merged."""
    T_first_second = SE3.exp([0, 0, 0.4, 3.0, -1.0, 0.0])
    sign = SE3.from_rotation(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), [4.0, 1.0, 1.5])
    maps = []
    for number, T_world_base in enumerate((SE3.identity(), T_first_second)):
        quats = ((T_world_base @ T_base_camera).inverse() @ sign).quat_xyzw[None]
        read = seen(
            1,
            sign.t.tolist(),
            T_world_base=T_world_base,
            texts=("EXIT 12",),
            quats_camera_object_xyzw=quats,
        )
        maps.append(await mapped(await measured(read), still(), mission=f"robot {number}"))

    merged, _ = merge(maps)
    solved, _ = optimize_map(merged)

    assert len(solved.landmarks) == 1
    T = solved.missions.T_map_mission
    np.testing.assert_allclose(np.linalg.inv(T[0]) @ T[1], T_first_second.matrix, atol=1e-3)


async def test_a_large_thing_is_less_sure_where_it_is() -> None:
    """20 px at 4 m with f = 50 px are 1.6 m; a tenth of that joins the 5 cm of a centre that says nothing."""
    (made,) = await measured(seen(1, (4.1, 0, 0.5)))

    assert np.sqrt(made.covariance[3, 3]) == pytest.approx(np.hypot(0.05, 0.16), rel=1e-3)


async def test_objects_without_a_place_are_counted() -> None:
    context = Context()
    config = ObjectMeasurementsConfig()
    nowhere = detections([(20, 10, 40, 30)], SECOND_NS)

    out = await run_operator(
        ObjectMeasurements(config), config=config, run_context=context, detections=[nowhere], odometry=still(),
    )  # fmt: skip

    assert out["constraints"] == []
    assert context.activity.warnings == {"objects of camera whose place in space is not known": 1}
