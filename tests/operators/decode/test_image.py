"""Compressed images become pixels; broken ones are counted and hold nobody up."""

from typing import Literal

import cv2
import numpy as np
import pytest

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

pytestmark = pytest.mark.anyio
_COLOR = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
_PLACE = SE3.exp([0, 0, 0, 1, 2, 3])


def _encoded(stamp_ns: int, pixels: np.ndarray, suffix: str = ".png") -> EncodedImage:
    done, data = cv2.imencode(suffix, pixels)
    assert done
    return EncodedImage(
        stamp_ns=stamp_ns, data=data, format=suffix[1:], frame="cam", T_base_sensor=_PLACE
    )


async def test_images_keep_their_stamp_order_and_place() -> None:
    images = [_encoded(k, np.roll(_COLOR, k, 0)) for k in range(6)]
    run_context = Context(placement="thread", workers=3)

    frames = (
        await run_operator(ImageDecode(ImageDecodeConfig()), run_context=run_context, images=images)
    )["frames"]

    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, np.roll(_COLOR, k, 0))
        assert (frame.stamp_ns, frame.encoding, frame.frame) == (k, "bgr8", "cam")
        assert frame.T_base_sensor is _PLACE
    assert len(frames) == 6


async def test_depth_of_16_bits_and_gray_stay_as_recorded() -> None:
    depth = np.arange(60, dtype=np.uint16).reshape(6, 10) * 1000
    images = [_encoded(0, depth), _encoded(1, _COLOR[:, :, 0]), _encoded(2, _COLOR)]

    as_recorded = await run_operator(ImageDecode(ImageDecodeConfig()), images=images)
    gray = await run_operator(ImageDecode(ImageDecodeConfig(mode="gray")), images=images[1:])
    in_mm = await run_operator(ImageDecode(ImageDecodeConfig(mode="depth")), images=images)

    assert [f.encoding for f in as_recorded["frames"]] == ["mono16", "mono8", "bgr8"]
    np.testing.assert_array_equal(as_recorded["frames"][0].image, depth)
    assert [f.encoding for f in gray["frames"]] == ["mono8", "mono8"]
    assert [f.encoding for f in in_mm["frames"]] == ["16UC1"]


async def test_an_image_that_cannot_be_decoded_is_counted_and_the_rest_goes_on() -> None:
    nonsense = EncodedImage(stamp_ns=1, data=np.zeros(50, np.uint8), format="jpeg", frame="cam")
    empty = EncodedImage(stamp_ns=2, data=np.zeros(0, np.uint8), format="jpeg", frame="cam")
    images = [_encoded(0, _COLOR), nonsense, empty, _encoded(3, _COLOR)]
    run_context = Context()

    out = await run_operator(
        ImageDecode(ImageDecodeConfig()), run_context=run_context, images=images
    )

    assert [frame.stamp_ns for frame in out["frames"]] == [0, 3]
    assert run_context.activity.losses == {"images of cam that cannot be decoded (jpeg)": 2}


@pytest.mark.parametrize(
    ("encoding", "mode", "expected"),
    [
        ("bgr8", "gray", "mono8"),
        ("rgb8", "gray", "mono8"),
        ("mono8", "gray", "mono8"),
        ("mono16", "gray", "mono8"),
        ("mono8", "color", "bgr8"),
        ("rgb8", "color", "bgr8"),
        ("mono16", "depth", "16UC1"),
        ("16UC1", "depth", "16UC1"),
        ("32FC1", "depth", "32FC1"),
        ("rgb8", "as_recorded", "rgb8"),
    ],
)
def test_recorded_pixels_become_what_a_decoded_file_would_be(
    encoding: str, mode: Literal["gray", "color", "depth", "as_recorded"], expected: str
) -> None:
    rng = np.random.default_rng(0)
    shape = (6, 8, 3) if encoding in ("bgr8", "rgb8") else (6, 8)
    dtype = {"mono16": np.uint16, "16UC1": np.uint16, "32FC1": np.float32}.get(encoding, np.uint8)
    image = (rng.uniform(0, 1, shape) * 255).astype(dtype)
    frame = CameraFrame(stamp_ns=1, image=image, encoding=encoding)

    made = ImageDecode(ImageDecodeConfig(mode=mode)).decode(frame)

    assert isinstance(made, CameraFrame)
    assert made.encoding == expected
    if encoding == "rgb8" and mode == "color":
        np.testing.assert_array_equal(made.image, image[:, :, ::-1])
    if (encoding, mode) == ("bgr8", "gray"):  # as the file of the same pixels
        data = np.frombuffer(cv2.imencode(".png", image)[1].tobytes(), np.uint8)
        file = EncodedImage(stamp_ns=1, data=data, format="png")
        decoded = ImageDecode(ImageDecodeConfig(mode="gray")).decode(file)
        assert isinstance(decoded, CameraFrame)
        assert np.abs(made.image.astype(int) - decoded.image.astype(int)).max() <= 1


async def test_recorded_pixels_that_are_no_depth_are_refused_and_counted() -> None:
    context = Context()
    frame = CameraFrame(stamp_ns=1, image=np.zeros((6, 8), np.uint8), encoding="mono8")

    sent = await run_operator(
        ImageDecode(ImageDecodeConfig(mode="depth")), run_context=context, images=[frame]
    )

    assert sent["frames"] == []
    assert context.activity.losses == {
        "images of camera that cannot be decoded (mono8 as depth)": 1
    }
