"""Stereo pairs: a point has one row in both images, and its disparity is its depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.rectify import Rectify, RectifyConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.camera_models import project
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.images.cameras import camera, points_before, ramp, ramp_at, sampled

pytestmark = pytest.mark.anyio
_LAST = np.array([158, 118])
_LEFT = SE3.exp([0.02, -0.03, 0.01, 0.3, 0.1, 0.2])
_RIGHT = _LEFT @ SE3.exp([-0.03, 0.02, 0.05, 0.11, 0.004, -0.003])


def _pair(stamp_ns: int = 0) -> tuple[CameraFrame, CameraFrame]:
    left = ramp(camera("radtan", frame="left"))
    right = ramp(camera("equidistant", frame="right", center_px=np.array([81.0, 58.0])))
    return (
        replace(left, T_base_sensor=_LEFT, stamp_ns=stamp_ns),
        replace(right, T_base_sensor=_RIGHT, stamp_ns=stamp_ns + 100_000),
    )


async def test_A20_rectified_pairs_have_one_row_and_a_disparity_for_each_point() -> None:
    left, right = _pair()

    out = await run_operator(Rectify(RectifyConfig()), left=[left], right=[right])

    (new_left,), (new_right,) = out["left"], out["right"]
    points = points_before(300) @ _LEFT.R.T + _LEFT.t
    px = {}
    for old, new in ((left, new_left), (right, new_right)):
        before, after = (_px(seen, points) for seen in (old, new))
        px[new.frame] = after
        inside = ((before > 1) & (before < _LAST) & (after > 1) & (after < _LAST)).all(axis=1)
        assert inside.sum() > 100
        np.testing.assert_allclose(
            sampled(new.image, after[inside]), ramp_at(before[inside]), atol=8
        )
    np.testing.assert_allclose(px["left"][:, 1], px["right"][:, 1], atol=1e-9)
    baseline_m = float(np.linalg.norm(_RIGHT.t - _LEFT.t))
    disparity = px["left"][:, 0] - px["right"][:, 0]
    depth_m = new_left.camera.focal_px[0] * baseline_m / disparity
    np.testing.assert_allclose(depth_m, _seen_from(new_left, points)[:, 2], rtol=1e-9)
    assert (new_left.camera.frame, new_right.camera.frame) == ("left", "right")


def _px(frame: CameraFrame, points_base: np.ndarray) -> np.ndarray:
    return project(require_camera(frame), _seen_from(frame, points_base))[0]


def _seen_from(frame: CameraFrame, points_base: np.ndarray) -> np.ndarray:
    T_sensor_base = frame.T_base_sensor.inverse()
    return points_base @ T_sensor_base.R.T + T_sensor_base.t


async def test_images_without_a_partner_are_counted() -> None:
    pairs = [_pair(k * 50_000_000) for k in range(3)]
    run_context = Context()

    out = await run_operator(
        Rectify(RectifyConfig()),
        run_context=run_context,
        left=[left for left, _ in pairs],
        right=[pairs[0][1], pairs[2][1]],
    )

    assert [f.stamp_ns for f in out["left"]] == [0, 100_000_000]
    (warning,) = run_context.activity.warnings
    assert "2 matched; 1 of left not" in warning


def test_cameras_that_are_no_pair_are_refused() -> None:
    left, right = _pair()

    rectify = Rectify(RectifyConfig())

    with pytest.raises(OperatorError, match="left and right sit at one place"):
        rectify.rectified(left, replace(right, T_base_sensor=_LEFT))
    with pytest.raises(OperatorError, match="left sits to the left of right; exchange"):
        rectify.rectified(right, left)
