"""Operators find keypoints with networks, and match them from image to image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.networks.matchers import normalized_px, one_to_one
from mapstream.operators.networks.network_tracker import NetworkTracker, NetworkTrackerConfig
from mapstream.operators.networks.superpoint import SuperPoint, SuperPointConfig
from mapstream.operators.networks.xfeat import XFeat, XFeatConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.networks.files import matcher_file, superpoint_file
from tests.operators.networks.pictures import picture
from tests.operators.networks.weights import installed
from tests.operators.tracking.hall_views import walk

pytestmark = pytest.mark.anyio


def _frame(image: np.ndarray, stamp_ns: int = 1) -> CameraFrame:
    return CameraFrame(stamp_ns=stamp_ns, image=image, encoding="mono8", frame="left")


def _dots(*places: tuple[int, int, int], size_px: tuple[int, int] = (64, 48)) -> np.ndarray:
    """Return a black image (H, W) with pixels x, y of a brightness."""
    image = np.zeros(size_px[::-1], np.uint8)
    for x, y, value in places:
        image[y, x] = value
    return image


@pytest.mark.parametrize("is_turned", [False, True])
async def test_D11_superpoint_comes_from_a_users_file(tmp_path: Path, *, is_turned: bool) -> None:
    file = superpoint_file(tmp_path, is_turned=is_turned)
    # the second is too near the first, the third too near the border, the fourth too dark
    image = _dots((20, 10, 250), (22, 11, 240), (2, 20, 255), (40, 20, 100), (50, 30, 200))
    config = SuperPointConfig(model=file)

    (found,) = (await run_operator(SuperPoint(config), frames=[_frame(image)]))["features"]

    assert found.kind == "superpoint"
    np.testing.assert_array_equal(found.keypoints_px, [[20, 10], [50, 30]])
    assert found.scores is not None
    np.testing.assert_allclose(found.scores, [250 / 255, 200 / 255], atol=1e-6)
    np.testing.assert_array_equal(found.descriptors, np.eye(256, dtype=np.float32)[[20, 50]])


async def test_D11_without_a_file_the_features_are_the_free_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed("xfeat")
    superpoint = SuperPoint(SuperPointConfig(max_features=40))

    (found,) = (await run_operator(superpoint, frames=[_frame(picture(7))]))["features"]

    assert found.kind == "xfeat"
    assert found.descriptors.shape == (40, 64)


async def test_keypoints_of_a_resized_image_are_where_they_are_in_the_image_itself(
    tmp_path: Path,
) -> None:
    image = np.zeros((96, 128), np.uint8)
    image[32:34, 60:62] = 255  # one pixel of the half image, around (60.5, 32.5)
    config = SuperPointConfig(model=superpoint_file(tmp_path), image_scale=0.5)

    (found,) = (await run_operator(SuperPoint(config), frames=[_frame(image)]))["features"]

    np.testing.assert_allclose(found.keypoints_px, [[60.5, 32.5]])
    assert found.sigmas_px is not None
    np.testing.assert_allclose(found.sigmas_px, 1.6)


async def test_black_small_and_wrong_images_are_survived(tmp_path: Path) -> None:
    installed("xfeat")
    black = np.zeros((96, 128), np.uint8)
    camera = CameraCalibration(
        width_px=10,
        height_px=10,
        focal_px=np.ones(2),
        center_px=np.ones(2),
        distortion_parameters=np.empty(0),
    )
    wrong = CameraFrame(stamp_ns=3, image=black, encoding="mono8", camera=camera)
    frames = [_frame(black, 1), _frame(black[:20, :20], 2), wrong, _frame(picture(1), 4)]
    context = Context()

    sent = await run_operator(XFeat(XFeatConfig()), run_context=context, frames=frames)

    assert [f.stamp_ns for f in sent["features"]] == [1, 2, 4]
    assert [len(f) > 0 for f in sent["features"]] == [False, False, True]
    assert list(context.activity.losses.values()) == [1]
    (warning,) = context.activity.warnings
    assert "without a keypoint" in warning


def test_a_file_with_other_ends_is_refused(tmp_path: Path) -> None:
    matcher = matcher_file(tmp_path, "lightglue")
    with pytest.raises(ConfigError, match="expected one input, an image"):
        SuperPoint(SuperPointConfig(model=matcher)).open()
    points = superpoint_file(tmp_path)
    with pytest.raises(ConfigError, match="no network that matches keypoints; it takes"):
        NetworkTracker(NetworkTrackerConfig(matcher=str(points)))._open()
    with pytest.raises(ConfigError, match="no matcher 'superglue'; expected lighterglue"):
        NetworkTracker(NetworkTrackerConfig(matcher="superglue"))._open()


def _seen(stamp_ns: int, points: list[int], width: int = 8) -> ImageFeatures:
    """Return features that see points, each with its own descriptor and place."""
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind="points",
        frame="left",
        keypoints_px=np.array([[10 * p, stamp_ns] for p in points], np.float32).reshape(-1, 2),
        descriptors=np.eye(width, dtype=np.float32)[points],
        scores=np.ones(len(points), np.float32),
    )


@pytest.mark.parametrize("layout", ["lightglue", "pairs", "superglue"])
async def test_D12_tracks_keep_their_numbers(tmp_path: Path, layout: str) -> None:
    """A point that is missed once keeps its number, one that is missed twice gets a new one."""
    config = NetworkTrackerConfig(matcher=str(matcher_file(tmp_path, layout)))
    images = [[0, 1, 2, 3], [3, 0, 4], [], [0, 4], [4, 1, 0], [0, 4]]
    features = [_seen(i, points) for i, points in enumerate(images)]

    sent = (await run_operator(NetworkTracker(config), features=features))["features"]

    ids: dict[int, list[int]] = {}
    for points, tracked in zip(images, sent, strict=True):
        assert tracked.track_ids is not None
        assert len(tracked) == len(points), "what is remembered is not sent"
        for point, track_id in zip(points, tracked.track_ids.tolist(), strict=True):
            ids.setdefault(point, []).append(track_id)
    assert [len(set(ids[point])) for point in range(5)] == [1, 2, 1, 1, 1]
    assert len({track_id for of_point in ids.values() for track_id in of_point}) == 6


async def test_features_that_a_matcher_cannot_take_are_named(tmp_path: Path) -> None:
    installed("lighterglue")
    features = [_seen(0, [0, 1]), _seen(1, [0, 1])]

    with pytest.raises(
        OperatorError, match=r"lighterglue: cannot be run on .*'desc0': \(1, 2, 8\)"
    ):
        await run_operator(NetworkTracker(NetworkTrackerConfig()), features=features)


def test_of_matches_that_share_a_keypoint_the_surest_stays() -> None:
    pairs = np.array([[0, 5], [1, 5], [2, 6], [2, 7], [3, 8]])

    kept = one_to_one(pairs, np.array([0.5, 0.9, 0.4, 0.3, 0.05]), 0.1)

    np.testing.assert_array_equal(kept, [[1, 5], [2, 6]])


def test_keypoints_are_scaled_by_the_image() -> None:
    frame = walk(1, 0)[0].camera_frame()
    features = ImageFeatures(
        stamp_ns=0,
        kind="xfeat",
        frame="front",
        keypoints_px=np.array([[0, 0], [640, 480], [320, 240]], np.float32),
        camera=frame.camera,
    )

    expected = np.array([[-1, -0.75], [1, 0.75], [0, 0]])
    np.testing.assert_allclose(normalized_px(features), expected)


@pytest.mark.slow
async def test_D12_xfeat_and_lighterglue_follow_points_through_ten_images() -> None:
    """In a walk through W-VI: at least 80 tracks span ten images, 95 % of them on one point to 4 px."""
    installed("xfeat", "lighterglue")
    views = walk(11, 0)
    frames = [view.camera_frame() for view in views]
    found = (await run_operator(XFeat(XFeatConfig()), frames=frames))["features"]

    tracker = NetworkTracker(NetworkTrackerConfig())
    tracked = (await run_operator(tracker, features=found))["features"]

    ends: dict[
        int, list[tuple[int, np.ndarray]]
    ] = {}  # image and place, of each sighting of a track
    for i, features in enumerate(tracked):
        assert features.track_ids is not None
        for track_id, px in zip(features.track_ids.tolist(), features.keypoints_px, strict=True):
            ends.setdefault(track_id, []).append((i, px))
    long = [(of[0], of[-1]) for of in ends.values() if of[-1][0] - of[0][0] >= 9]
    errors_px = [
        np.linalg.norm(views[i].px_in(views[j], before[None])[0] - now)
        for (i, before), (j, now) in long
    ]
    assert len(long) >= 80
    assert np.mean(np.array(errors_px) < 4) >= 0.95
