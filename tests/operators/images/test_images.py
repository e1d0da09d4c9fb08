"""One image made of one image: its pixels, and the calibration that belongs to them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapstream.operators.features.gray import gray
from mapstream.operators.images.clahe import Clahe, ClaheConfig
from mapstream.operators.images.eight_bits import EightBits, EightBitsConfig
from mapstream.operators.images.gray import Gray
from mapstream.operators.images.resize import Resize, ResizeConfig
from mapstream.operators.images.undistort import Undistort, UndistortConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.camera_models import project
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame, RecordRef
from tests.operators.images.cameras import (
    LENSES,
    camera,
    frame,
    points_before,
    ramp,
    ramp_at,
    sampled,
)

pytestmark = pytest.mark.anyio
_RECORD = RecordRef(path="a.mcap", topic="/cam", log_ns=1)


def _texture(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray:
    """Return blocks of grey between 0 and 1."""
    blocks = np.random.default_rng(seed).uniform(0, 1, (height // 8, width // 8))
    return np.kron(blocks, np.ones((8, 8)))


def test_A20_clahe_spreads_the_contrast_of_each_part() -> None:
    dim = frame((60 + 10 * _texture()).astype(np.uint8), "mono8")
    bright = frame((20000 + 900 * _texture()).astype(np.uint16), "mono16")

    clahe = Clahe(ClaheConfig(clip_limit=4.0))

    assert clahe.changed(dim).image.std() > 2 * dim.image.std()
    assert clahe.changed(bright).image.std() > 2 * bright.image.std()


def test_A20_clahe_of_colours_leaves_the_hue() -> None:
    image = np.stack([30 + 10 * _texture(), 60 + 20 * _texture(), 90 + 30 * _texture()], axis=2)
    color = frame(image.astype(np.uint8), "rgb8")

    changed = Clahe(ClaheConfig()).changed(color)

    before, after = (cv2.cvtColor(f.image, cv2.COLOR_RGB2LAB) for f in (color, changed))
    assert after[..., 0].std() > 1.2 * before[..., 0].std()
    assert np.abs(after[..., 1:].astype(int) - before[..., 1:]).mean() < 2


def test_A20_a_thermal_image_has_keypoints_once_it_has_8_bits() -> None:
    """A dead pixel and a burning one leave 30 counts of 65535 to the room; percentiles find them."""
    counts = 29500 + 30 * cv2.GaussianBlur(_texture(240, 320), (0, 0), 1.5)
    image = counts.astype(np.uint16)
    image[3, 5], image[200, 300] = 0, 65535
    thermal = frame(image, "mono16")

    def num_keypoints(seen: CameraFrame) -> int:
        return len(cv2.ORB.create(500).detect(gray(seen)))

    assert num_keypoints(thermal) < 10
    assert num_keypoints(EightBits(EightBitsConfig(range="min_max")).changed(thermal)) < 10
    assert num_keypoints(EightBits(EightBitsConfig()).changed(thermal)) > 100


def test_A20_8_bits_of_a_fixed_range_are_the_same_in_every_image() -> None:
    config = EightBitsConfig(range="fixed", least=1000, most=1255)
    values = np.array([[0, 1000, 1100, 1255, 9000]], np.uint16)

    assert EightBits(config).changed(frame(values, "mono16")).image.tolist() == [
        [0, 0, 100, 255, 255]
    ]
    flat = EightBits(EightBitsConfig()).changed(frame(values * 0 + 7, "mono16"))
    assert not flat.image.any()


def test_A20_grey_of_both_orders_of_colours() -> None:
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 0] = 255

    assert Gray().changed(frame(red, "rgb8")).image[0, 0] == 76
    assert Gray().changed(frame(red[..., ::-1], "bgr8")).image[0, 0] == 76
    thermal = frame(red[..., 0].astype(np.uint16), "mono16")
    assert Gray().changed(thermal) is thermal


@pytest.mark.parametrize("options", [{"scale": 0.5}, {"scale": 0.75}, {"width_px": 240}])
def test_A20_in_another_size_points_are_still_where_the_calibration_says(
    options: dict[str, float],
) -> None:
    old = camera("radtan")
    whole = replace(ramp(old), record=_RECORD)

    resized = Resize(ResizeConfig.model_validate(options)).changed(whole)

    assert resized.camera is not None
    points = points_before(200)
    before, after = project(old, points)[0], project(resized.camera, points)[0]
    np.testing.assert_allclose(sampled(resized.image, after), ramp_at(before), atol=16)  # 0.1 px
    assert resized.record is None, "what is recorded has another size"


def test_A20_depth_is_never_averaged() -> None:
    depth = np.where(np.arange(20) < 11, 1000, 3000).astype(np.uint16)[None].repeat(4, axis=0)

    resized = Resize(ResizeConfig(scale=0.5)).changed(frame(depth, "16UC1"))

    assert set(np.unique(resized.image)) == {1000, 3000}


@pytest.mark.parametrize("zoom", [1.0, 0.7])
@pytest.mark.parametrize("lens", list(LENSES))
async def test_A20_undistorted_images_are_those_of_a_pinhole_camera(lens: str, zoom: float) -> None:
    old = camera(lens)
    operator = Undistort(UndistortConfig(zoom=zoom))

    out = await run_operator(operator, run_context=Context(), frames=[ramp(old)] * 2)

    straight = out["frames"][1]
    new = straight.camera
    assert (new.model, new.distortion, new.width_px) == ("pinhole", "none", 160)
    points = points_before(200)
    before, after = project(old, points)[0], project(new, points)[0]
    margin = np.array([158, 118])
    inside = ((before > 1) & (before < margin) & (after > 1) & (after < margin)).all(axis=1)
    assert inside.sum() > 80
    np.testing.assert_allclose(
        sampled(straight.image, after[inside]), ramp_at(before[inside]), atol=8
    )


def test_what_a_stage_cannot_work_on_is_named() -> None:
    with pytest.raises(OperatorError, match="the camera cam has no calibration"):
        Undistort(UndistortConfig()).changed(frame(np.zeros((2, 2), np.uint8), "mono8"))
    depth = frame(np.zeros((2, 2), np.uint16), "16UC1")
    with pytest.raises(OperatorError, match="clahe: images of cam are 16UC1; it takes bgr8"):
        Clahe(ClaheConfig()).changed(depth)
