"""Features of other programs come in as they are, or are named and left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mapstream.operators.features.external_features import (
    ExternalFeatures,
    ExternalFeaturesConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.images.cameras import camera

pytestmark = pytest.mark.anyio


def _features(stamp_ns: int = 5, num: int = 12, **fields: Any) -> ImageFeatures:  # noqa: ANN401
    made: dict[str, Any] = {
        "kind": "mine",
        "frame": "cam0",
        "keypoints_px": np.arange(2 * num, dtype=np.float32).reshape(num, 2),
        "track_ids": np.arange(num),
    }
    return ImageFeatures(stamp_ns=stamp_ns, **(made | fields))


async def test_D8_messages_pass_untouched_with_the_ids_of_their_tracks() -> None:
    given = [
        _features(5, track_ids=np.array([7, -1, *range(100, 110)])),
        _features(6, kind="other", descriptors=np.ones((12, 32), np.uint8)),
        _features(7, kind="points", points_m=np.ones((12, 3), np.float32)),
    ]

    out = await run_operator(ExternalFeatures(ExternalFeaturesConfig()), features=given)

    assert out["features"] == given


async def test_cameras_that_all_count_from_zero_get_numbers_that_differ() -> None:
    config = ExternalFeaturesConfig(ids_per_camera=True)
    given = [
        _features(5, frame=frame, track_ids=np.array([0, 1, -1, *range(9, 18)]))
        for frame in ("left", "right", "left")
    ]

    left, right, again = (await run_operator(ExternalFeatures(config), features=given))["features"]

    assert np.intersect1d(left.track_ids, right.track_ids).tolist() == [-1]
    np.testing.assert_array_equal(left.track_ids, again.track_ids)
    assert left.track_ids[1] - left.track_ids[0] == 1


async def test_U2_what_cannot_be_used_is_counted_by_its_reason() -> None:
    run_context = Context()
    given = [
        _features(1, descriptors=np.ones((12, 64), np.float32)),
        _features(2, track_ids=np.zeros(12, np.int64)),
        _features(3, descriptors=np.ones((12, 32), np.float32)),
        _features(4, camera=camera(), keypoints_px=np.full((12, 2), 500, np.float32)),
        _features(5, kind="unwanted"),
        _features(6, descriptors=np.ones((12, 64), np.float32)),
    ]
    config = ExternalFeaturesConfig(kinds=("mine",))

    out = await run_operator(ExternalFeatures(config), run_context=run_context, features=given)

    assert [features.stamp_ns for features in out["features"]] == [1, 6]
    losses = list(run_context.activity.losses)
    assert losses[0] == (
        "features mine of cam0: a track id comes twice in one image; it names one point"
    )
    assert "of kind mine are float32 x 32, and were float32 x 64 before" in losses[-2]
    assert any("most keypoints are outside of the image" in loss for loss in losses)
    assert list(run_context.activity.warnings) == [
        "features unwanted of cam0 are not among `kinds`"
    ]
