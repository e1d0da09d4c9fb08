"""Depth moved into the colour camera is what that camera would have measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.images.depth_registration import (
    DepthRegistration,
    DepthRegistrationConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.images.cameras import camera, frame

pytestmark = pytest.mark.anyio
_PLACE = SE3.exp([0.01, -0.008, 0.02, 0.03, 0.002, -0.004])  # of the colour camera, seen from depth
_NORMAL, _DISTANCE_M = np.array([0.2, 0.1, -1.0]), -2.0  # a slanted wall, in the depth camera


def _wall(calibration: CameraCalibration, place: SE3) -> np.ndarray:
    """Return the depth (H, W) [m] of the wall, seen by a camera without distortion."""
    normal = place.R.T @ _NORMAL
    distance_m = _DISTANCE_M - _NORMAL @ place.t
    x, y = np.meshgrid(np.arange(calibration.width_px), np.arange(calibration.height_px))
    rays = np.stack([(x - calibration.center_px[0]) / calibration.focal_px[0],
                     (y - calibration.center_px[1]) / calibration.focal_px[1],
                     np.ones_like(x, float)], axis=-1)  # fmt: skip
    return np.asarray(distance_m / (rays @ normal))


def _pair(encoding: str, color: CameraCalibration) -> tuple[CameraFrame, CameraFrame]:
    depth = camera(frame="depth")
    wall = _wall(depth, SE3.identity())
    image = wall * 1000 if encoding == "16UC1" else wall
    dtype = np.uint16 if encoding == "16UC1" else np.float32
    return (
        frame(np.round(image, 6).astype(dtype), encoding, depth),
        frame(np.zeros((120, 160), np.uint8), "mono8", color, _PLACE),
    )


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("focal_px", [95.0, 150.0])
async def test_registered_depth_is_that_of_the_colour_camera(
    encoding: str, focal_px: float
) -> None:
    """With a longer focal length too: a pixel of depth covers several of colour, without holes."""
    color = camera(frame="color", focal_px=np.full(2, focal_px))
    depth, seen = _pair(encoding, color)

    out = await run_operator(
        DepthRegistration(DepthRegistrationConfig()), depth=[depth], frames=[seen]
    )

    (moved,) = out["depth"]
    assert (moved.frame, moved.encoding, moved.T_base_sensor) == ("color", encoding, _PLACE)
    assert moved.camera is color
    found_m = depth_m_of(moved)
    inner = found_m[30:90, 40:120]
    assert np.isfinite(inner).mean() > (0.99 if focal_px > 110 else 0.85)
    error_m = inner - _wall(color, _PLACE)[30:90, 40:120]
    assert np.nanmax(np.abs(error_m)) < 0.02  # a pixel on the slanted wall


async def test_what_is_near_hides_what_is_far_and_no_depth_stays_none() -> None:
    depth, seen = _pair("16UC1", camera(frame="color"))
    image = np.full((120, 160), 3000, np.uint16)
    image[40:80, 60:100] = 1000
    image[:20] = 0

    (moved,) = (
        await run_operator(
            DepthRegistration(DepthRegistrationConfig()),
            depth=[replace(depth, image=image)],
            frames=[replace(seen, T_base_sensor=SE3.exp([0, 0, 0, 0.1, 0, 0]))],
        )
    )["depth"]

    # 0.1 m to the right, the near square is seen 11 px to the left, the wall 3.7 px
    assert (moved.image[45:75, 51:87] == 1000).all()
    assert (moved.image[45:75, 110:150] == 3000).all()
    assert not moved.image[:19].any()


async def test_depth_without_an_image_near_it_is_named() -> None:
    depth, seen = _pair("16UC1", camera(frame="color"))
    run_context = Context()

    out = await run_operator(
        DepthRegistration(DepthRegistrationConfig()),
        run_context=run_context,
        depth=[depth],
        frames=[replace(seen, stamp_ns=10**9)],
    )

    assert out["depth"] == []
    (warning,) = run_context.activity.warnings
    assert "1 of depth not" in warning
    with pytest.raises(OperatorError, match="depth: images of color are mono8"):
        DepthRegistration(DepthRegistrationConfig()).registered(seen, depth)
