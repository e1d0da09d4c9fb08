"""Stereo and RGB-D odometry against motions that are known, and against input that lacks something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.odometry.visual.visual_odometry import (
    VisualOdometry,
    VisualOdometryConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures, NFrame
from tests.operators.odometry.flight import Flight

pytestmark = pytest.mark.anyio
FLIGHT = Flight(duration_s=3.0, num_cameras=2)


async def estimate(
    frames: Sequence[NFrame], context: Context | None = None, **options: float
) -> list[Odometry]:
    config = VisualOdometryConfig.model_validate({"sigma_px": 0.5, **options})
    out = await run_operator(VisualOdometry(config), run_context=context, n_frames=frames)
    return out["odometry"]


def errors_m(flight: Flight, found: Sequence[Odometry]) -> np.ndarray:
    """Return how far each pose is from the truth, seen from the first."""
    stamps = np.array([each.stamp_ns for each in found])
    truth = flight.truth(stamps)
    truth = invert(truth[0]) @ truth
    path = np.array([each.T_odom_base.t for each in found])
    return np.asarray(np.linalg.norm(path - truth[:, :3, 3], axis=1))


def with_depth(frames: Sequence[NFrame], sigma_m: float = 0.01) -> list[NFrame]:
    """Return what the left camera saw, with the distance to each point that the pair implies."""
    rng = np.random.default_rng(7)
    found = []
    for frame in frames:
        left, right = frame.features
        assert left.track_ids is not None
        assert right.track_ids is not None
        assert left.camera is not None
        ids, i, j = np.intersect1d(left.track_ids, right.track_ids, return_indices=True)
        disparity = (left.keypoints_px[i] - right.keypoints_px[j])[:, 0].astype(float)
        z = 400 * 0.2 / np.maximum(disparity, 2) + rng.standard_normal(len(ids)) * sigma_m
        ahead = (left.keypoints_px[i] - left.camera.center_px) / left.camera.focal_px
        points = np.column_stack([ahead, np.ones(len(ids))]) * z[:, None]
        points[::4] = np.nan
        sees = replace(
            left,
            keypoints_px=left.keypoints_px[i],
            track_ids=ids,
            points_m=points,
            point_sigmas_m=np.full(len(ids), 0.6),
        )
        found.append(replace(frame, features=(sees,)))
    return found


def described(frames: Sequence[NFrame]) -> list[NFrame]:
    """Return keypoints that have descriptors in the place of tracks."""
    words = np.random.default_rng(3).integers(0, 256, (300, 32), dtype=np.uint8)

    def without_tracks(features: ImageFeatures) -> ImageFeatures:
        return replace(features, descriptors=words[features.track_ids], track_ids=None)

    return [replace(f, features=tuple(map(without_tracks, f.features))) for f in frames]


async def test_a_stereo_pair_finds_its_path() -> None:
    found = await estimate(FLIGHT.frames(), most_baselines=60)

    assert errors_m(FLIGHT, found).max() < 0.05
    assert not any(each.is_lost for each in found)
    assert found[0].covariance is None


async def test_depth_beside_one_camera_finds_its_path() -> None:
    found = await estimate(with_depth(FLIGHT.frames()))

    assert errors_m(FLIGHT, found).max() < 0.1


async def test_descriptors_take_the_place_of_tracks_at_a_low_rate() -> None:
    flight = replace(FLIGHT, image_hz=2.0, swing_m=0.4)

    found = await estimate(described(with_depth(flight.frames())))

    assert errors_m(flight, found).max() < 0.1
    assert not any(each.is_lost for each in found)


async def test_the_covariance_of_steps_is_about_that_of_their_errors() -> None:
    found = await estimate(FLIGHT.frames(), most_baselines=60)

    truth = FLIGHT.truth(np.array([each.stamp_ns for each in found]))
    distances = []
    for k in range(1, len(found)):
        step = found[k - 1].T_odom_base.inverse() @ found[k].T_odom_base
        error = (step.inverse() @ SE3(invert(truth[k - 1]) @ truth[k])).log()
        covariance = found[k].covariance
        assert covariance is not None
        distances.append(error @ np.linalg.solve(covariance, error))
    assert 0.5 < np.mean(distances) < 18


async def test_far_points_of_a_pair_that_errs_do_less_harm() -> None:
    """Calibration that is half a pixel out moves a point 40 baselines away by five of them."""
    half = np.array([0.5, 0.0], np.float32)
    frames = []
    for frame in FLIGHT.frames():
        left, right = frame.features
        frames.append(
            replace(
                frame,
                features=(left, replace(right, keypoints_px=right.keypoints_px + half)),
            )
        )

    near, all_ = [await estimate(frames, most_baselines=many) for many in (40, 1000)]

    assert errors_m(FLIGHT, near).mean() < 0.8 * errors_m(FLIGHT, all_).mean()


async def test_dark_images_are_predicted_and_named_and_then_it_starts_anew() -> None:
    frames = FLIGHT.frames()
    dark = slice(10, 18)
    frames[dark] = [NFrame(stamp_ns=f.stamp_ns, features=()) for f in frames[dark]]
    context = Context()

    found = await estimate(frames, context, most_baselines=60)

    assert len(found) == len(frames)
    assert [each.is_lost for each in found][dark] == [True] * 8
    assert not any(each.is_lost for each in found[19:])
    assert any("without a pose" in each for each in context.activity.warnings)


async def test_false_tracks_are_left_out() -> None:
    rng = np.random.default_rng(5)
    frames = []
    for frame in FLIGHT.frames():
        shaken = []
        for seen in frame.features:
            assert seen.track_ids is not None
            px, false = np.array(seen.keypoints_px), seen.track_ids % 4 == 0
            px[false] += rng.uniform(-30, 30, (int(false.sum()), 2))
            shaken.append(replace(seen, keypoints_px=px))
        frames.append(replace(frame, features=tuple(shaken)))

    found = await estimate(frames, most_baselines=60)

    assert errors_m(FLIGHT, found).max() < 0.08
