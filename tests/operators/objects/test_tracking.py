"""Objects keep their numbers while they are followed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mapstream.operators.objects.rows import rows_of
from mapstream.operators.objects.tracking.object_tracker import ObjectTracker, ObjectTrackerConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.w_rgbd import WRgbdConfig, w_rgbd
from mapstream.streams.messages.objects import ObjectDetections
from tests.operators.objects.made_detections import detections

pytestmark = pytest.mark.anyio

SECOND_NS = 1_000_000_000
BOXES = np.array([[5.0, 5, 15, 20], [30, 8, 42, 18], [20, 30, 30, 44]])  # of 64 x 48 px
SPEED = np.array([[4.0, 0, 4, 0], [-3, 2, -3, 2], [3, -1, 3, -1]])  # [px/s]


def seen(
    t_s: float,
    rows: Sequence[int] = (0, 1, 2),
    **more: Any,  # noqa: ANN401  # fields
) -> ObjectDetections:
    """Return three objects, or some of them, that move on at one speed each."""
    boxes = (BOXES + t_s * SPEED)[list(rows)]
    return detections(boxes.tolist(), round(t_s * SECOND_NS) + 1, track_ids=None, **more)


def ids_of(objects: ObjectDetections) -> list[int]:
    assert objects.track_ids is not None
    ids: list[int] = objects.track_ids.tolist()
    return ids


def unit(rows: np.ndarray) -> np.ndarray:
    scaled: np.ndarray = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return scaled


@pytest.mark.parametrize("rate_hz", [3.0, 10.0, 30.0])
def test_J3_ids_are_stable_through_half_a_second_without_being_seen(rate_hz: float) -> None:
    tracker = ObjectTracker(ObjectTrackerConfig())
    ids = []

    for t_s in np.arange(0, 4, 1 / rate_hz):
        is_hidden = 2.0 <= t_s < 2.5
        ids.append(ids_of(tracker.track(seen(t_s, (1, 2) if is_hidden else (0, 1, 2)))))

    assert len(set(ids[-1])) == 3
    for found in ids[3:]:
        assert found == ids[-1] or found == ids[-1][1:]


@pytest.fixture(scope="module")
def walk_round_the_table() -> list[tuple[ObjectDetections, ObjectDetections]]:
    """W-RGBD, 5 images a second: what a detector with errors of all kinds says, and the truth."""
    detector = {"score": 0.95, "score_sigma": 0.05, "box_noise_px": 0.75, "min_pixels": 20}
    camera = {"width_px": 320, "height_px": 240, "rate_hz": 5.0}
    world = {"camera": camera, "texel_m": 0.05}
    records = w_rgbd(WRgbdConfig.model_validate(world | {"objects": detector}), 0).records
    sent: dict[str, list[ObjectDetections]] = {"/color/objects": [], "/truth/objects": []}
    for record in records:
        if isinstance(record.message, ObjectDetections):
            sent[record.topic].append(record.message)
    return list(zip(*sent.values(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("are_hidden", [False, True])
def test_J3_ids_hardly_switch_in_w_rgbd(
    walk_round_the_table: list[tuple[ObjectDetections, ObjectDetections]], *, are_hidden: bool
) -> None:
    """At most two: a thing that was not out of sight for longer than a track lasts goes on under another number.

    Also if each thing is hidden for 0.6 s of every 3.6 s, and whenever it is taken for another thing.
    """
    config = ObjectTrackerConfig()
    tracker = ObjectTracker(config)
    last: dict[str, tuple[int, int]] = {}
    things = sorted({name for _, truth in walk_round_the_table for name in truth.texts if name})
    num_switches = 0
    for number, (found, truth) in enumerate(walk_round_the_table):
        names = truth.texts[: len(found)]
        turn = number % 18 // 3  # of the thing that is hidden: 3 images in a row of 18
        true = [
            name == label and name != things[turn]
            for name, label in zip(names, found.labels, strict=True)
        ]
        is_seen = np.array(true, np.bool_) | (not are_hidden)
        sent = tracker.track(rows_of(found, is_seen))
        name_of = dict(zip(map(tuple, found.boxes_px.tolist()), names, strict=True))
        for box, track_id in zip(map(tuple, sent.boxes_px.tolist()), ids_of(sent), strict=True):
            before, stamp_ns = last.get(name_of[box], (track_id, 0))
            is_followed = sent.stamp_ns - stamp_ns <= config.max_age_s * SECOND_NS
            num_switches += name_of[box] != "" and is_followed and before != track_id
            last[name_of[box]] = track_id, sent.stamp_ns

    assert set(things) <= set(last)
    assert num_switches <= 2


def test_a_track_ends_when_its_time_is_over() -> None:
    tracker = ObjectTracker(ObjectTrackerConfig(max_age_s=0.4, num_hits=1))
    first = [tracker.track(seen(t_s)) for t_s in (0.0, 0.1)][-1]
    tracker.track(seen(0.2, (1, 2)))

    later = tracker.track(seen(0.6))

    assert [a == b for a, b in zip(ids_of(first), ids_of(later), strict=True)] == [
        False,
        True,
        True,
    ]


def test_J3_what_is_unsure_or_seen_twice_only_is_dropped() -> None:
    tracker = ObjectTracker(ObjectTrackerConfig())
    scores = np.array([0.9, 0.79, 0.81], np.float32)

    sent = [tracker.track(seen(t_s / 10, scores=scores)) for t_s in range(4)]

    assert [len(objects) for objects in sent] == [0, 0, 2, 2]
    assert np.allclose(sent[-1].scores, scores[[0, 2]])


def test_an_unsure_track_ends_when_it_is_missed() -> None:
    tracker = ObjectTracker(ObjectTrackerConfig())

    sent = [tracker.track(seen(k / 10, (0,) if k != 2 else ())) for k in range(6)]

    assert [len(objects) for objects in sent] == [0, 0, 0, 0, 0, 1]


def test_classes_have_rules_of_their_own_and_never_mix() -> None:
    tracker = ObjectTracker(
        ObjectTrackerConfig.model_validate(
            {"num_hits": 1, "classes": {"mug": {"min_score": 0.95}, "bowl": {"num_hits": 2}}}
        )
    )
    labels = ("cup", "mug", "bowl")

    first, second, third = (
        tracker.track(seen(k / 10, labels=labels if k < 2 else ("bowl", "mug", "bowl")))
        for k in range(3)
    )

    assert (first.labels, second.labels) == (("cup",), ("cup", "bowl"))
    assert third.labels == ("bowl",)  # what was a cup is a new bowl, seen once
    assert ids_of(third)[0] == ids_of(second)[1]


def test_looks_tell_objects_apart_that_meet() -> None:
    """Two cups meet, and go back where they came from; by motion alone they would have passed each other."""
    rng = np.random.default_rng(1)
    looks = unit(rng.normal(size=(2, 32)))
    tracker = ObjectTracker(ObjectTrackerConfig())
    ids = []
    for k, x in enumerate([*np.linspace(0, 20, 30), *np.linspace(20, 0, 30)]):
        boxes = [(5 + x, 10, 15 + x, 20), (45 - x, 14, 55 - x, 24)]
        given = unit(looks + 0.05 * rng.normal(size=looks.shape))
        sent = tracker.track(detections(boxes, k * 50_000_000 + 1, descriptors=given))
        ids.append(ids_of(sent))

    assert ids[3:] == [ids[3]] * 57
    assert len(set(ids[3])) == 2


def test_without_some_descriptors_motion_decides() -> None:
    looks = unit(np.random.default_rng(1).normal(size=(3, 8)))
    looks[1] = np.nan
    tracker = ObjectTracker(ObjectTrackerConfig())

    sent = [tracker.track(seen(k / 10, descriptors=looks)) for k in range(6)]

    ids = [ids_of(objects) for objects in sent[2:]]
    assert ids == [ids[0]] * 4
    assert len(set(ids[0])) == 3


def test_an_image_without_any_descriptor_changes_nothing() -> None:
    looks = unit(np.random.default_rng(1).normal(size=(3, 8)))
    tracker = ObjectTracker(ObjectTrackerConfig())
    ids = []

    for k in range(8):
        given = {4: None, 5: np.full((3, 8), np.nan), 6: np.empty((3, 0))}.get(k, looks)
        ids.append(ids_of(tracker.track(seen(k / 10, descriptors=given, descriptor_kind="this"))))

    assert ids[2:] == [ids[2]] * 6


def test_another_network_starts_the_galleries_anew() -> None:
    tracker = ObjectTracker(ObjectTrackerConfig())
    rng, ids = np.random.default_rng(1), []
    for k in range(8):
        looks = unit(rng.normal(size=(3, 8 if k < 4 else 16)))
        kind = "this" if k < 4 else "that"
        rng = np.random.default_rng(1)
        ids.append(ids_of(tracker.track(seen(k / 10, descriptors=looks, descriptor_kind=kind))))

    assert ids[3] == ids[7]


def test_the_surer_of_two_detections_of_one_object_counts() -> None:
    tracker = ObjectTracker(ObjectTrackerConfig(num_hits=1))
    boxes = [(10, 10, 30, 30), (10.5, 10, 30.5, 30), (40, 10, 50, 30)]
    scores = np.array([0.85, 0.95, 0.9], np.float32)

    sent = tracker.track(detections(boxes, scores=scores))

    np.testing.assert_allclose(sent.boxes_px[:, 0], [10.5, 40])


async def test_ids_differ_between_cameras_and_runs_are_alike() -> None:
    messages = []
    for k in range(5):
        for camera in ("left", "right"):
            objects = seen(k / 10)
            messages.append(
                ObjectDetections(
                    stamp_ns=objects.stamp_ns,
                    frame=camera,
                    width_px=64,
                    height_px=48,
                    boxes_px=objects.boxes_px,
                    labels=objects.labels,
                    scores=objects.scores,
                )
            )

    runs = [
        (await run_operator(ObjectTracker(ObjectTrackerConfig()), detections=messages))[
            "detections"
        ]
        for _ in range(2)
    ]

    ids = [[ids_of(objects) for objects in run] for run in runs]
    assert ids[0] == ids[1]
    assert not set(ids[0][-1]) & set(ids[0][-2])
    assert len(runs[0]) == len(messages)  # those with nothing left as well


async def test_bad_boxes_and_old_images_are_counted_and_survived() -> None:
    nan = float("nan")
    bad = detections([(5, 5, 5, 20), (nan, 0, 1, 1), (9, 9, 8, 12), (5, 5, 15, 20)], 1)
    context = Context()

    sent = await run_operator(
        ObjectTracker(ObjectTrackerConfig(num_hits=1)),
        run_context=context,
        detections=[bad, seen(0.1), seen(0.05), seen(0.1)],
    )

    assert [len(objects) for objects in sent["detections"]] == [1, 3]
    assert context.activity.warnings == {"objects of camera whose box has no area were dropped": 3}
    (lost,) = context.activity.losses.items()
    assert lost == ("objects of camera that came again, or after later ones", 2)


async def test_a_detector_that_is_never_sure_enough_is_told() -> None:
    context = Context()
    unsure = [seen(k / 10, scores=np.full(3, 0.6, np.float32)) for k in range(4)]

    await run_operator(ObjectTracker(ObjectTrackerConfig()), run_context=context, detections=unsure)

    (warning,) = context.activity.warnings
    assert warning.startswith("no object was tracked; the best score was 0.60 (min_score 0.8")


def test_five_hundred_objects_in_an_image() -> None:
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 40, (500, 2))
    boxes = np.concatenate([low, low + rng.uniform(2, 8, (500, 2))], axis=1)
    tracker = ObjectTracker(ObjectTrackerConfig())

    sent = [tracker.track(detections(boxes.tolist(), k * 100_000_000 + 1)) for k in range(3)]

    assert len(sent[-1]) > 400
    assert len(set(ids_of(sent[-1]))) == len(sent[-1])


def test_rows_keep_all_that_is_known() -> None:
    objects = seen(0.0, texts=("a", "b", "c"), extents_m=np.arange(9.0).reshape(3, 3))

    chosen = rows_of(objects, np.array([False, True, True]))

    assert chosen.texts == ("b", "c")
    assert chosen.extents_m is not None
    assert chosen.extents_m[0].tolist() == [3, 4, 5]
    assert rows_of(objects, np.array([2, 0])).texts == ("c", "a")
