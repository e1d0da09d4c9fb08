"""ORB on images whose content we know."""

import cv2
import numpy as np
import pytest

from mapstream.operators.features.features import Orb, OrbConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.messages.sensors import CameraFrame

pytestmark = pytest.mark.anyio
_NOISE = cv2.resize(
    np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8), (320, 240),
    interpolation=cv2.INTER_CUBIC,
)  # fmt: skip


def _frame(image: np.ndarray, encoding: str = "mono8") -> CameraFrame:
    return CameraFrame(stamp_ns=7, image=image, encoding=encoding, frame="left")


async def test_keypoints_are_bounded_sorted_and_the_same_twice() -> None:
    run_context = Context(placement="thread", workers=2)
    frames = [_frame(_NOISE)] * 3

    out = await run_operator(
        Orb(OrbConfig(max_features=100)), run_context=run_context, frames=frames
    )

    first, second, _ = out["features"]
    assert 50 < len(first.keypoints_px) <= 100
    assert (np.diff(first.scores) <= 0).all()
    assert first.descriptors.shape == (len(first.keypoints_px), 32)
    assert (first.kind, first.frame, first.stamp_ns) == ("orb", "left", 7)
    np.testing.assert_array_equal(first.keypoints_px, second.keypoints_px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


async def test_a_shifted_image_has_the_same_descriptors_elsewhere() -> None:
    shifted = np.roll(_NOISE, 16, axis=1)

    out = await run_operator(Orb(OrbConfig()), frames=[_frame(_NOISE), _frame(shifted)])

    a, b = out["features"]
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a.descriptors, b.descriptors)
    moves = np.array([b.keypoints_px[m.trainIdx] - a.keypoints_px[m.queryIdx] for m in matches])
    is_right = np.linalg.norm(moves - [16, 0], axis=1) < 2
    assert is_right.mean() > 0.7


@pytest.mark.parametrize(
    ("image", "encoding"),
    [
        (np.full((50, 60), 9, np.uint8), "mono8"),
        (np.zeros((50, 60, 3), np.uint8), "bgr8"),
        (np.zeros((50, 60), np.uint16), "mono16"),
    ],
)
async def test_an_image_without_corners_gives_no_keypoints(
    image: np.ndarray, encoding: str
) -> None:
    (features,) = (await run_operator(Orb(OrbConfig()), frames=[_frame(image, encoding)]))[
        "features"
    ]

    assert features.keypoints_px.shape == (0, 2)
    assert features.descriptors.shape == (0, 32)


async def test_16_bit_and_colour_images_are_seen_as_gray() -> None:
    deep = _NOISE.astype(np.uint16) * 100
    color = np.repeat(_NOISE[:, :, None], 3, axis=2)

    out = await run_operator(
        Orb(OrbConfig()),
        frames=[_frame(deep, "mono16"), _frame(color, "rgb8"), _frame(color, "bgr8")],
    )

    assert all(len(features.keypoints_px) > 100 for features in out["features"])
