"""Tracks by descriptors: windows where the gyroscope says, match rules, agreement with one translation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.features.features import Features, FeaturesConfig
from mapstream.operators.operator import Activity, Context
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.descriptor_matching import MatchRules, matched
from mapstream.operators.tracking.feature_tracker import FeatureTracker, FeatureTrackerConfig
from mapstream.operators.tracking.klt import Klt
from mapstream.operators.tracking.klt_tracker import KltConfig
from mapstream.operators.tracking.track_ids import TrackNumbers, carried_on
from mapstream.operators.tracking.turning import camera_turn, turned_px
from mapstream.operators.tracking.two_point import OutlierOptions, agreeing
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.tracking.hall_views import CAMERA, T_BASE_CAMERA, HallView, gyro, walk

pytestmark = pytest.mark.anyio
_YAW_DEGPS = 60.0


def _features(views: tuple[HallView, ...], kind: str = "brisk") -> list[ImageFeatures]:
    detector = Features(FeaturesConfig.model_validate({"kind": kind}))
    return [detector.detect(view.camera_frame()) for view in views]


def _rows(a: ImageFeatures, b: ImageFeatures) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the keypoints that two messages have under one number."""
    assert a.track_ids is not None
    assert b.track_ids is not None
    return np.intersect1d(a.track_ids, b.track_ids, return_indices=True)[1:]


async def test_D4_the_gyroscope_tells_where_to_look() -> None:
    views = walk(6, _YAW_DEGPS)
    found = _features(views)
    imu = gyro(views, _YAW_DEGPS)

    aided = await run_operator(FeatureTracker(FeatureTrackerConfig()), features=found, imu=imu)
    plain = await run_operator(FeatureTracker(FeatureTrackerConfig()), features=found)

    num_right, num_all, num_plain = 0, 0, 0
    for i in range(1, len(views)):
        a, b = aided["features"][i - 1 : i + 1]
        rows_a, rows_b = _rows(a, b)
        truth = views[i - 1].px_in(views[i], a.keypoints_px[rows_a])
        num_right += int((np.linalg.norm(truth - b.keypoints_px[rows_b], axis=1) < 3).sum())
        num_all += len(rows_a)
        turn = camera_turn(imu, views[i - 1].stamp_ns, views[i].stamp_ns, T_BASE_CAMERA)
        expected = turned_px(CAMERA, a.keypoints_px[rows_a], turn)
        assert np.linalg.norm(expected - b.keypoints_px[rows_b], axis=1).max() <= 20
        a, b = plain["features"][i - 1 : i + 1]
        rows_a, rows_b = _rows(a, b)
        truth = views[i - 1].px_in(views[i], a.keypoints_px[rows_a])
        num_plain += int((np.linalg.norm(truth - b.keypoints_px[rows_b], axis=1) < 3).sum())
    assert num_right / num_all >= 0.98
    assert num_right >= 2 * num_plain


async def test_D4_the_large_window_is_for_those_without_a_match_in_the_small_one() -> None:
    bits = np.random.default_rng(0).integers(0, 256, (2, 64), np.uint8)
    before = ImageFeatures(
        stamp_ns=1, kind="brisk", frame="a", keypoints_px=np.array([[50, 50], [200, 50]]),
        descriptors=bits,
    )  # fmt: skip
    now = replace(
        before,
        stamp_ns=2,
        keypoints_px=np.array([[55, 50], [66, 50], [215, 50], [221, 50]]),
        descriptors=bits[[0, 0, 1, 1]],
    )
    # the first has equals 5 and 16 px away: the near one; the second 15 and 21 px away: that in reach
    tracker = FeatureTracker(FeatureTrackerConfig())

    first, second = tracker.track(before), tracker.track(now)

    rows_a, rows_b = _rows(first, second)
    assert rows_a.tolist() == [0, 1]
    assert rows_b.tolist() == [0, 2]


def _flipped(bits: np.ndarray, share: float) -> np.ndarray:
    """Return descriptors (1, 64) of which a share of the bits differs."""
    unpacked = np.unpackbits(bits)
    unpacked[: round(share * unpacked.size)] ^= 1
    return np.packbits(unpacked)[None]


_BITS = np.random.default_rng(1).integers(0, 256, (1, 64), np.uint8)
_RULES = MatchRules()


def test_D5_four_fifths_of_the_bits_are_equal() -> None:
    assert len(matched(_BITS, _flipped(_BITS, 0.195), _RULES)) == 1
    assert len(matched(_BITS, _flipped(_BITS, 0.205), _RULES)) == 0


def test_D5_the_best_is_better_than_the_second_best() -> None:
    second = _flipped(_BITS, 0.10)
    near, far = _flipped(_BITS, 0.07), _flipped(_BITS, 0.09)

    assert matched(_BITS, np.concatenate([second, near]), _RULES).tolist() == [[0, 1]]
    assert matched(_BITS, np.concatenate([second, far]), _RULES).tolist() == []


def test_D5_a_keypoint_matches_once_and_the_loser_tries_again_under_a_stricter_rule() -> None:
    before = np.concatenate([_BITS, _flipped(_BITS, 0.02)])
    both = np.concatenate([_BITS, _flipped(_BITS, 0.14)])  # 12 % from the second of before
    apart = np.concatenate([_BITS, _flipped(_BITS, 0.18)])  # 16 %

    assert matched(before, both, _RULES).tolist() == [[0, 0], [1, 1]]
    assert matched(before, apart, _RULES).tolist() == [[0, 0]]
    assert matched(before, both, MatchRules(num_rounds=0)).tolist() == [[0, 0]]


def test_D5_numbers_are_compared_by_their_angle() -> None:
    axis = np.eye(8, dtype=np.float32)

    def at(degrees: float, towards: int = 1) -> np.ndarray:
        angle = np.radians(degrees)
        turned: np.ndarray = np.cos(angle) * axis[:1] + np.sin(angle) * axis[towards : towards + 1]
        return 300 * turned

    assert len(matched(axis[:1], at(36), _RULES)) == 1  # cos 36 deg = 0.809
    assert len(matched(axis[:1], at(38), _RULES)) == 0  # 0.788
    assert len(matched(axis[:1], np.concatenate([at(10), at(15, 2)]), _RULES)) == 1
    assert len(matched(axis[:1], np.concatenate([at(13), at(15, 2)]), _RULES)) == 0


@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.integers(0, 30))
@settings(max_examples=40, deadline=None)
def test_D5_matches_are_always_one_to_one(seed: int, num_before: int, num_now: int) -> None:
    rng = np.random.default_rng(seed)
    before = rng.integers(0, 2, (num_before, 8), np.uint8)  # few bits, many alike
    now = rng.integers(0, 2, (num_now, 8), np.uint8)

    matches = matched(before, now, MatchRules(max_ratio=1.0))

    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)


@pytest.mark.parametrize("seed", range(20))
def test_D6_two_points_tell_the_translation_and_outliers_go(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -3, 2], [4, 3, 15], (300, 3))
    T_now_before = SE3.exp([*rng.normal(0, 0.05, 3), *rng.normal(0, 0.15, 3)])
    before = _rays(points, rng)
    now = _rays(T_now_before @ points, rng)
    outliers = rng.random(300) < 0.3
    now[outliers] = _rays(rng.uniform([-4, -3, 2], [4, 3, 15], (int(outliers.sum()), 3)), rng)
    drift = so3_exp([0.0005, -0.001, 0.0005])  # of a gyroscope with a bias, in 50 ms

    agree = agreeing(before, now, drift @ T_now_before.R, OutlierOptions(), seed)

    assert (~agree[outliers]).mean() >= 0.95
    assert agree[~outliers].mean() >= 0.95


def _rays(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = (
        points / points[:, 2:]
        + np.c_[rng.normal(0, 0.5 / 400, (len(points), 2)), np.zeros(len(points))]
    )
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))


def test_D6_a_camera_that_stands_or_only_turns_loses_nothing() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform([-4, -3, 2], [4, 3, 15], (200, 3))
    turn = so3_exp([0.02, 0.05, -0.03])

    for R in (np.eye(3), turn):
        agree = agreeing(_rays(points, rng), _rays(points @ R.T, rng), R, OutlierOptions(), 1)
        assert agree.mean() > 0.98


async def test_a_gyroscope_that_is_wrong_is_blamed_instead_of_the_tracks() -> None:
    views = walk(4, 0.0)
    rolling = [
        replace(b, gyro_radps=b.gyro_radps + np.array([1.5, 0, 0])) for b in gyro(views, 0.0)
    ]
    activity = Activity()

    out = await run_operator(
        Klt(KltConfig()),
        run_context=Context(activity=activity),
        frames=[view.camera_frame() for view in views],
        imu=rolling,
    )

    found = out["features"]
    assert min(len(_rows(found[i - 1], found[i])[0]) for i in (1, 2, 3)) > 150
    assert activity.warnings == {
        "most tracks disagree with the gyroscope; are its extrinsics and its clock right?": 3
    }


def test_carried_on_gives_each_keypoint_a_number_that_no_other_has() -> None:
    numbers = TrackNumbers("front")
    first = carried_on(np.empty(0, np.int64), np.empty((0, 2), np.int64), 3, numbers)
    second = carried_on(first, np.array([[0, 1], [2, 0]]), 4, numbers)

    assert second[1] == first[0]
    assert second[0] == first[2]
    assert len({*first, *second}) == 5
    assert min(*first, *second) >= 0


@pytest.mark.parametrize(("max_missed", "is_found"), [(2, True), (1, False)])
async def test_a_missed_keypoint_waits_where_the_camera_turns_it(
    *, max_missed: int, is_found: bool
) -> None:
    px = np.array([[320.0, 240.0]], np.float32)
    step = so3_exp([0, 0.05, 0])  # 20 px
    bits = np.random.default_rng(0).integers(0, 256, (1, 64), np.uint8)
    tracker = FeatureTracker(FeatureTrackerConfig(max_missed=max_missed))
    seen = []
    for i in range(4):
        is_missed = i in (1, 2)
        message = ImageFeatures(
            stamp_ns=i + 1, kind="brisk", frame="front", camera=CAMERA,
            keypoints_px=np.empty((0, 2), np.float32) if is_missed else px,
            descriptors=bits[:0] if is_missed else bits,
        )  # fmt: skip
        seen.append(tracker.track(message, step if i else None))
        px = turned_px(CAMERA, px, step)

    assert (seen[0].track_ids == seen[3].track_ids) == is_found


async def test_what_the_imu_lacks_is_counted_and_tracking_goes_on() -> None:
    views = walk(6, 0.0)
    found = _features(views)
    imu = gyro(views, 0.0)
    late = [replace_stamps(batch, 10**12) for batch in imu]
    with_gap = imu[:2] + imu[5:]

    for samples, num_missing in ((late, 5), (with_gap, 4)):
        activity = Activity()
        out = await run_operator(
            FeatureTracker(FeatureTrackerConfig()),
            run_context=Context(activity=activity),
            features=found,
            imu=samples,
        )
        assert len(out["features"]) == 6
        ((warning, count),) = activity.warnings.items()
        assert "front" in warning
        assert "do their clocks agree?" in warning
        assert count == num_missing
        assert len(_rows(*out["features"][:2])[0]) > 100


def replace_stamps(batch: ImuBatch, shift_ns: int) -> ImuBatch:
    return replace(batch, stamps_ns=batch.stamps_ns + shift_ns)
