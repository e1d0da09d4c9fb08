"""The detector family on textures whose every pixel we know."""

from __future__ import annotations

from typing import get_args

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from mapstream.operators.features.detectors import DetectorKind
from mapstream.operators.features.features import Features, FeaturesConfig
from mapstream.operators.features.rows import appended, rows_of
from mapstream.operators.features.spread import Spread, apart, spread
from mapstream.operators.operator import Activity, Context
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.descriptor_matching import MatchRules, matched
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.tracking.wall import CAMERA, texture

pytestmark = pytest.mark.anyio
_VGA = texture(1)[:480, :640]
_WIDTH = {"orb": 32, "brisk": 64, "freak": 64, "sift": 128}


def _frame(image: np.ndarray) -> CameraFrame:
    return CameraFrame(stamp_ns=7, image=image, encoding="mono8", frame="left")


def _detect(image: np.ndarray, kind: DetectorKind, **options: float) -> ImageFeatures:
    config = FeaturesConfig.model_validate({"kind": kind, **options})
    return Features(config).detect(_frame(image))


@pytest.mark.parametrize("kind", ["orb", "brisk", "freak"])
def test_D1_a_textured_image_gives_many_points_spread_over_it_and_none_close(
    kind: DetectorKind,
) -> None:
    found = _detect(_VGA, kind)

    assert 500 <= len(found) <= 700
    assert pdist(found.keypoints_px).min() > 8
    cells = (found.keypoints_px // [160, 240]).astype(int)
    counts = np.unique(cells @ [1, 4], return_counts=True)[1]
    assert len(counts) == 8
    assert counts.max() <= 2 * 700 / 8
    assert (np.diff(np.array(found.scores)) <= 0).all()


@pytest.mark.parametrize(
    ("row", "kind", "width"), [("D2", "brisk", 64), ("D3", "freak", 64), ("D10", "sift", 128)]
)
def test_D2_D3_descriptors_match_when_the_image_turns_and_grows(
    row: str, kind: DetectorKind, width: int
) -> None:
    turn = cv2.getRotationMatrix2D((320, 240), 30, 1.2)
    turned = cv2.warpAffine(_VGA, turn, (640, 480))

    a, b = (
        _detect(np.asarray(image, np.uint8), kind, max_features=300) for image in (_VGA, turned)
    )

    assert a.descriptors.shape[1] == width
    assert a.descriptors.dtype == (np.float32 if kind == "sift" else np.uint8)
    matches = matched(a.descriptors, b.descriptors, MatchRules(min_similarity=0.0))
    truth = a.keypoints_px[matches[:, 0]] @ turn[:, :2].T + turn[:, 2]
    inside = ((truth > 30) & (truth < [610, 450])).all(axis=1)
    is_true = np.linalg.norm(truth - b.keypoints_px[matches[:, 1]], axis=1) < 3
    assert inside.sum() > 50, row
    assert is_true[inside].mean() >= 0.7, row


def test_D3_one_word_switches_the_descriptor_and_keeps_the_detector() -> None:
    brisk, freak = _detect(_VGA, "brisk"), _detect(_VGA, "freak")

    assert {brisk.kind, freak.kind} == {"brisk", "freak"}
    assert brisk.descriptors.shape[1] == freak.descriptors.shape[1] == 64
    shared = {tuple(px) for px in brisk.keypoints_px} & {tuple(px) for px in freak.keypoints_px}
    assert len(shared) > 300


@pytest.mark.parametrize("kind", get_args(DetectorKind))
def test_D19_every_keypoint_knows_its_uncertainty_score_scale_and_orientation(
    kind: DetectorKind,
) -> None:
    found = _detect(_VGA[:240, :320], kind)

    for array in (found.sigmas_px, found.scores, found.scales, found.orientations_rad):
        assert array is not None
        assert array.shape == (len(found),)
        assert np.isfinite(array).all()
    assert found.sigmas_px is not None
    assert (found.sigmas_px == np.float32(0.8)).all()


def test_a_point_of_a_smaller_image_is_less_certain() -> None:
    levels = _detect(_VGA, "orb", num_levels=4)
    assert levels.sigmas_px is not None
    np.testing.assert_allclose(np.unique(levels.sigmas_px), 0.8 * 1.2 ** np.arange(4), rtol=1e-6)

    half, full = (_detect(_VGA, "sift", image_scale=scale) for scale in (0.5, 1.0))
    assert half.sigmas_px is not None
    assert (half.sigmas_px == np.float32(1.6)).all()
    nearest = np.linalg.norm(half.keypoints_px[:, None] - full.keypoints_px[None], axis=2).min(1)
    assert (nearest < 1.5).mean() > 0.5


@pytest.mark.parametrize("kind", get_args(DetectorKind))
async def test_black_images_and_those_of_a_wrong_size_are_counted(kind: DetectorKind) -> None:
    black = CameraFrame(stamp_ns=1, image=np.zeros((240, 320), np.uint8), encoding="mono8")
    small = CameraFrame(
        stamp_ns=2, image=np.zeros((120, 160), np.uint8), encoding="mono8", camera=CAMERA
    )
    activity = Activity()

    out = await run_operator(
        Features(FeaturesConfig(kind=kind)),
        run_context=Context(activity=activity),
        frames=[black, small],
    )

    (features,) = out["features"]
    assert len(features) == 0
    assert features.descriptors.shape == (0, _WIDTH[kind])
    assert activity.warnings == {
        "images of camera without a keypoint: too dark, or without texture": 1
    }
    (loss,) = activity.losses
    assert "160 x 120 px, where the calibration is of 320 x 240 px" in loss


_POINTS = st.lists(
    st.tuples(st.floats(0, 99, width=32), st.floats(0, 79, width=32)), min_size=1, max_size=60
)


@given(_POINTS, st.integers(0, 5), st.integers(1, 40))
@settings(max_examples=50, deadline=None)
def test_spread_keeps_its_limits_and_wastes_nothing(
    points: list[tuple[float, float]], num_live: int, limit: int
) -> None:
    px = np.array(points, np.float32)
    live, scores = px[:num_live], np.arange(len(px), dtype=np.float32)[::-1]
    wanted = Spread(limit=limit, min_distance_px=5.0, border_px=3.0)

    kept = spread(px, scores, (100, 80), wanted, live)

    assert len(kept) <= max(0, limit - len(live))
    assert (np.diff(kept) > 0).all()  # scores fall with the row
    both = np.concatenate([px[kept], live])
    for i in range(len(kept)):
        assert (np.delete(np.linalg.norm(both - both[i], axis=1), i) > 5).all()
        assert (both[i] >= 3).all()
        assert (both[i] <= [96, 76]).all()


@given(_POINTS)
@settings(max_examples=50, deadline=None)
def test_apart_drops_a_point_only_for_a_stronger_one_that_stays(
    points: list[tuple[float, float]],
) -> None:
    px = np.array(points, np.float32)

    kept = apart(px, 5.0)

    for row in np.flatnonzero(~kept):
        stronger = px[:row][kept[:row]]
        assert (np.linalg.norm(stronger - px[row], axis=1) <= 5 + 1e-4).any()


def test_rows_and_appended_keep_what_is_known_with_its_keypoint() -> None:
    found = _detect(_VGA[:240, :320], "brisk")

    again = appended(rows_of(found, np.arange(10)), rows_of(found, np.arange(len(found)) >= 10))

    for name in ("keypoints_px", "descriptors", "scores", "sigmas_px"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    unknown = rows_of(_detect(_VGA[:240, :320], "brisk"), np.arange(3))
    without = ImageFeatures(
        stamp_ns=7, kind="brisk", frame="left", keypoints_px=unknown.keypoints_px,
        descriptors=unknown.descriptors,
    )  # fmt: skip
    assert appended(found, without).scores is None
