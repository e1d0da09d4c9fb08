"""Lucas-Kanade tracks of a wall whose every pixel we know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.operators.features.features import Features, FeaturesConfig
from mapstream.operators.features.rows import rows_of
from mapstream.operators.operator import Activity, Context
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.feature_tracker import FeatureTracker, FeatureTrackerConfig
from mapstream.operators.tracking.klt import Klt
from mapstream.operators.tracking.klt_tracker import KltConfig
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures
from tests.data import shared
from tests.operators.tracking.hall_views import gyro as hall_gyro
from tests.operators.tracking.hall_views import walk
from tests.operators.tracking.wall import CAMERA, View, drive, gyro

pytestmark = pytest.mark.anyio
_BASELINE = SE3.from_rotation(np.eye(3), [0.1, 0, 0])
_FAST, _STILL = (0.0, 1.0, 0.2), (0.0, 0.0, 0.0)


def _steps(before: ImageFeatures, now: ImageFeatures) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (N, 2) in two images of the tracks that both have."""
    assert before.track_ids is not None
    assert now.track_ids is not None
    _, a, b = np.intersect1d(before.track_ids, now.track_ids, return_indices=True)
    return before.keypoints_px[a], now.keypoints_px[b]


def _errors_px(views: list[View], features: list[ImageFeatures]) -> np.ndarray:
    errors = []
    for i in range(1, len(views)):
        start, end = _steps(features[i - 1], features[i])
        errors.append(np.linalg.norm(views[i - 1].px_in(views[i], start) - end, axis=1))
    return np.concatenate(errors)


async def _run(views: list[View], **inputs: Sequence[Any]) -> dict[str, list[ImageFeatures]]:
    given: dict[str, Any] = {"frames": [view.camera_frame() for view in views], **inputs}
    return await run_operator(Klt(KltConfig()), **given)


async def test_tracks_are_where_the_wall_is_and_keep_their_numbers() -> None:
    views = drive(8, (0.0, 0.1, 0.1), (0.4, 0.1, 0.3))

    features = (await _run(views))["features"]

    errors = _errors_px(views, features)
    assert np.median(errors) < 0.1
    assert (errors < 0.5).mean() > 0.97
    assert [len(found) > 60 for found in features] == [True] * 8
    assert {found.kind for found in features} == {"klt"}
    start, _ = _steps(features[0], features[-1])
    assert len(start) > 0.7 * len(features[0])


async def test_the_gyroscope_finds_what_a_fast_turn_moves_far() -> None:
    views = drive(4, (0.0, 2.0, 0.0), _STILL)  # 22 px between images
    options = KltConfig(num_levels=0)
    frames = [view.camera_frame() for view in views]

    alone = await run_operator(Klt(options), frames=frames)
    aided = await run_operator(Klt(options), frames=frames, imu=gyro(views, (0.0, 2.0, 0.0)))

    both = [len(_steps(f["features"][0], f["features"][1])[0]) for f in (alone, aided)]
    assert both[1] > 3 * both[0]
    assert np.median(_errors_px(views, aided["features"])) < 0.1


async def test_the_right_image_has_the_numbers_of_the_left_one() -> None:
    views = drive(5, (0.0, 0.1, 0.0), (0.2, 0.0, 0.1))
    rights = [
        replace(
            v, T_wall_camera=v.T_wall_camera @ _BASELINE, frame="right", T_base_sensor=_BASELINE
        )
        for v in views
    ]

    out = await _run(views, right_frames=[view.camera_frame() for view in rights])

    for view, right, a, b in zip(
        views, rights, out["features"], out["right_features"], strict=True
    ):
        assert b.frame == "right"
        assert len(b) > 0.8 * len(a)
        start, end = _steps(a, b)
        assert len(start) == len(b)
        assert np.median(np.linalg.norm(view.px_in(right, start) - end, axis=1)) < 0.1


async def test_the_same_images_give_the_same_tracks() -> None:
    views = drive(4, _FAST, (0.3, 0.0, 0.0))

    first, second = [(await _run(views, imu=gyro(views, _FAST)))["features"] for _ in range(2)]

    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
        np.testing.assert_array_equal(a.track_ids, b.track_ids)


async def test_cameras_number_their_tracks_apart() -> None:
    views = drive(1, _STILL, _STILL)
    ids = [
        np.array((await _run([replace(views[0], frame=name)]))["features"][0].track_ids)
        for name in ("left", "rear")
    ]

    assert not set(ids[0]) & set(ids[1])
    assert min(ids[0].min(), ids[1].min()) >= 0


def _lengths(found: Sequence[ImageFeatures]) -> np.ndarray:
    ids = np.concatenate([np.array(f.track_ids) for f in found])
    return np.unique(ids, return_counts=True)[1]


async def test_D7_detections_of_any_kind_become_long_tracks() -> None:
    views = walk(14, 20.0)
    frames = [view.camera_frame() for view in views]
    shapes = [  # blobs of MSER, a detector that no operator knows, with a descriptor of two numbers
        ImageFeatures(
            stamp_ns=frame.stamp_ns,
            kind="blob",
            frame=frame.frame,
            keypoints_px=np.array([k.pt for k in blobs]),
            descriptors=np.array([[k.size, k.response] for k in blobs], np.float32),
            camera=frame.camera,
        )
        for frame in frames
        for blobs in [cv2.MSER.create(max_area=400).detect(frame.image)]
    ]

    out = await run_operator(
        Klt(KltConfig(max_tracks=600, min_distance_px=7)),
        frames=frames,
        imu=hall_gyro(views, 20.0),
        features=shapes,
    )

    found = out["features"]
    assert {f.kind for f in found} == {"blob"}
    assert all(len(f) > 40 and f.descriptors.shape == (len(f), 2) for f in found)
    assert _lengths(found).mean() >= 8
    for i in range(1, len(views)):
        start, end = _steps(found[i - 1], found[i])
        errors = np.linalg.norm(views[i - 1].px_in(views[i], start) - end, axis=1)
        assert np.median(errors) < 0.2
        assert (errors > 3).mean() < 0.01


async def test_D7_what_does_not_come_back_to_its_start_is_no_track() -> None:
    views = drive(2, _STILL, _STILL)
    first, second = (view.camera_frame() for view in views)
    image = np.array(second.image)
    image[:, 160:] = np.random.default_rng(0).integers(
        0, 255, (240, 160)
    )  # nothing is there any more
    changed = replace(second, image=image)

    out = await run_operator(Klt(KltConfig()), frames=[first, changed])

    start, end = _steps(*out["features"])
    assert (start[:, 0] < 155).sum() > 20
    right = start[:, 0] > 175
    assert right.sum() <= 0.05 * (out["features"][0].keypoints_px[:, 0] > 175).sum()
    assert np.abs(start[~right] - end[~right]).max() < 1


async def test_D10_sift_points_are_followed_and_keep_their_descriptors() -> None:
    views = drive(6, (0.0, 0.1, 0.1), (0.3, 0.1, 0.2))
    frames = [view.camera_frame() for view in views]
    sift = (
        await run_operator(Features(FeaturesConfig(kind="sift", max_features=200)), frames=frames)
    )["features"]

    found = (await run_operator(Klt(KltConfig()), frames=frames, features=sift))["features"]

    assert {f.kind for f in found} == {"sift"}
    assert all(f.descriptors.shape == (len(f), 128) for f in found)
    assert np.median(_errors_px(views, found)) < 0.15
    _, a, b = np.intersect1d(
        np.array(found[0].track_ids), np.array(found[-1].track_ids), return_indices=True
    )
    assert len(a) > 0.7 * len(found[0])
    first, last = found[0].descriptors[a], found[-1].descriptors[b]
    cosines = (first * last).sum(1) / np.linalg.norm(first, axis=1) / np.linalg.norm(last, axis=1)
    assert np.median(cosines) > 0.9
    renewed = (first != last).any(axis=1)
    assert renewed.mean() > 0.5  # from the detection at the track's place


async def test_D9_kinds_are_tracked_side_by_side_and_never_meet() -> None:
    views = drive(3, (0.0, 0.05, 0.0), _STILL)
    frames = [view.camera_frame() for view in views]
    tracks: dict[str, list[ImageFeatures]] = {
        "klt": (await run_operator(Klt(KltConfig()), frames=frames))["features"]
    }
    mixed = []
    for kind in ("brisk", "sift"):
        config = FeaturesConfig.model_validate({"kind": kind, "max_features": 150})
        mixed += (await run_operator(Features(config), frames=frames))["features"]
    mixed.sort(key=lambda f: f.stamp_ns)

    # one tracker may serve several kinds
    for message in (await run_operator(FeatureTracker(FeatureTrackerConfig()), features=mixed))[
        "features"
    ]:
        tracks.setdefault(message.kind, []).append(message)

    assert sorted(tracks) == ["brisk", "klt", "sift"]
    for kind, found in tracks.items():
        assert [f.stamp_ns for f in found] == [frame.stamp_ns for frame in frames]
        assert {f.descriptors.shape[1] for f in found} == {
            {"brisk": 64, "sift": 128, "klt": 0}[kind]
        }
        start, end = _steps(found[0], found[1])
        assert len(start) > 30
        assert np.median(np.linalg.norm(views[0].px_in(views[1], start) - end, axis=1)) < 1


async def test_black_frames_end_all_tracks_and_light_begins_new_ones() -> None:
    views = drive(6, _STILL, (0.1, 0.0, 0.0))
    frames = [view.camera_frame() for view in views]
    for i in (2, 3):
        frames[i] = replace(frames[i], image=np.zeros_like(frames[i].image))
    activity = Activity()

    out = await run_operator(
        Klt(KltConfig()), run_context=Context(activity=activity), frames=frames
    )

    counts = [len(f) for f in out["features"]]
    assert counts[2:4] == [0, 0]
    assert min(counts[:2] + counts[4:]) > 60
    ids = [set(np.array(f.track_ids)) for f in (out["features"][1], out["features"][4])]
    assert not ids[0] & ids[1]
    assert activity.warnings == {"images of left without a corner: too dark, or without texture": 2}


async def test_images_of_another_size_or_without_a_partner_are_counted() -> None:
    views = drive(5, _STILL, _STILL)
    frames = [view.camera_frame() for view in views]
    small = CameraFrame(
        stamp_ns=frames[2].stamp_ns, image=frames[2].image[:120, :160], encoding="mono8",
        frame="left", camera=frames[2].camera,
    )  # fmt: skip
    frames[2] = small
    rights = [replace(frame, frame="right") for frame in frames[:4]]
    rights[1] = replace(rights[1], image=rights[1].image[:100, :100], camera=None)
    activity = Activity()

    out = await run_operator(
        Klt(KltConfig()),
        run_context=Context(activity=activity),
        frames=frames,
        right_frames=rights,
    )

    assert [f.stamp_ns for f in out["features"]] == [f.stamp_ns for f in frames if f is not small]
    assert [f.stamp_ns for f in out["right_features"]] == [rights[0].stamp_ns, rights[3].stamp_ns]
    assert sorted(activity.losses.values()) == [1, 1]
    assert any("160 x 120 px, where the calibration is of" in text for text in activity.losses)
    assert any("right that are not as large as those of left" in text for text in activity.losses)
    assert activity.warnings["images of left without one of the right camera"] == 1
    # two cameras in one place are no pair: nothing checks what they match, and the user hears of it
    assert any("without calibration" in text for text in activity.warnings)


async def test_keypoints_of_another_kind_or_length_are_named_and_left_out() -> None:
    views = drive(5, _STILL, _STILL)
    frames = [view.camera_frame() for view in views]
    given = [Features(FeaturesConfig(kind="brisk", max_features=60)).detect(f) for f in frames]
    given[0] = rows_of(given[0], np.arange(0))  # tracks begin with the third image
    given[1] = rows_of(given[1], np.arange(0))
    given[4] = replace(given[4], kind="freak")
    given[3] = replace(given[3], descriptors=given[3].descriptors[:, :32])
    activity = Activity()

    out = await run_operator(
        Klt(KltConfig()), run_context=Context(activity=activity), frames=frames, features=given
    )

    assert {f.kind for f in out["features"]} == {"brisk"}
    assert {f.descriptors.shape[1] for f in out["features"] if len(f)} == {64}
    assert activity.warnings == {
        "keypoints of kind freak where tracks are of kind brisk; "
        "give each kind an operator of its own": 1,
        "descriptors of kind brisk changed their length from 64 to 32": 1,
    }


async def test_a_camera_without_calibration_is_tracked_without_the_gyroscope() -> None:
    views = drive(3, _STILL, (0.1, 0.0, 0.0))
    frames = [replace(view.camera_frame(), camera=None) for view in views]
    activity = Activity()

    out = await run_operator(
        Klt(KltConfig()),
        run_context=Context(activity=activity),
        frames=frames,
        imu=gyro(views, _STILL),
    )

    assert len(_steps(out["features"][0], out["features"][-1])[0]) > 50
    assert activity.warnings == {"left has no calibration, so that the gyroscope cannot help": 2}


@pytest.mark.slow
async def test_real_stereo_pairs_are_followed_and_matched() -> None:
    folder = shared("kitti_stereo")
    K, baseline_m = 707.0912, 379.8145 / 707.0912
    frames: dict[str, list[CameraFrame]] = {"l": [], "r": []}
    for side, place in (("l", 0.0), ("r", baseline_m)):
        for i, path in enumerate(sorted((folder / f"image_{side}").glob("*.png"))[:6]):
            image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
            camera = replace(
                CAMERA,
                width_px=image.shape[1],
                height_px=image.shape[0],
                focal_px=np.array([K, K]),
                center_px=np.array([601.8873, 183.1104]),
            )
            frames[side].append(
                CameraFrame(
                    stamp_ns=i * 10**8,
                    image=image,
                    encoding="mono8",
                    frame=side,
                    camera=camera,
                    T_base_sensor=SE3.from_rotation(np.eye(3), [place, 0, 0]),
                )
            )

    out = await run_operator(Klt(KltConfig()), frames=frames["l"], right_frames=frames["r"])

    for i, (left, right) in enumerate(zip(out["features"], out["right_features"], strict=True)):
        assert len(left) == 250
        start, end = _steps(left, right)
        assert len(end) > 0.6 * len(left)
        assert np.percentile(np.abs(start - end)[:, 1], 95) < 1.5  # rectified: rows are equal
        assert np.percentile((start - end)[:, 0], 5) > 0
        if i:
            assert len(_steps(out["features"][i - 1], left)[0]) > 0.65 * len(left)
