"""Lucas-Kanade tracks of a wall whose every pixel we know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.klt import Klt
from mapstream.operators.tracking.klt_tracker import KltConfig
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.tracking.wall import View, drive, gyro

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
