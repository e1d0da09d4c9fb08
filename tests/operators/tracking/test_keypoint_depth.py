"""Keypoints get 3D points from registered depth; where depth says nothing they stay rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.keypoint_depth import KeypointDepth, KeypointDepthConfig
from mapstream.streams.camera_models import project
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.images.cameras import camera, frame

pytestmark = pytest.mark.anyio
_CAMERA = camera("radtan")
_PX = np.array([[40.0, 30.0], [100.2, 80.4], [20.0, 100.0], [120.0, 30.0], [159.0, 50.0]])


def _features(px: np.ndarray = _PX, stamp_ns: int = 7) -> ImageFeatures:
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind="klt",
        frame="cam",
        keypoints_px=px.astype(np.float32),
        track_ids=np.arange(len(px)),
        camera=_CAMERA,
    )


def _depth(encoding: str = "16UC1") -> CameraFrame:
    """Return a wall 2.5 m away, a near thing at the right above, a hole at the left below."""
    depth_m = np.full((120, 160), 2.5)
    depth_m[:, 120:] = 1.0
    depth_m[90:, :40] = 0.0
    depth_m[95:] = np.where(depth_m[95:] > 0, 20.0, 0.0)
    image = depth_m * 1000 if encoding == "16UC1" else np.where(depth_m > 0, depth_m, np.nan)
    return frame(image.astype(np.uint16 if encoding == "16UC1" else np.float32), encoding, _CAMERA)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
async def test_D18_keypoints_get_points_where_depth_is_known_and_smooth(encoding: str) -> None:
    """On the wall; not in a hole, not at an edge where depth is of one side or the other, nor at the border."""
    features = _features()

    (seen,) = (
        await run_operator(
            KeypointDepth(KeypointDepthConfig()), features=[features], depth=[_depth(encoding)]
        )
    )["features"]

    assert seen.points_m is not None
    assert seen.point_sigmas_m is not None
    has_point = np.isfinite(seen.points_m).all(axis=1)
    assert has_point.tolist() == [True, True, False, False, False]
    np.testing.assert_allclose(seen.points_m[:2, 2], 2.5, atol=1e-3)
    again = project(_CAMERA, seen.points_m[:2].astype(np.float64))[0]
    np.testing.assert_allclose(again, _PX[:2], atol=0.01)
    assert (seen.point_sigmas_m > 0).all()
    assert seen.track_ids is not None
    assert seen.track_ids.tolist() == [0, 1, 2, 3, 4]


async def test_D18_far_depth_is_less_sure_and_beyond_the_range_there_is_none() -> None:
    config = KeypointDepthConfig(max_depth_m=6.0)
    depth = _depth()
    images = {m: np.full((120, 160), 1000 * m, np.uint16) for m in (1, 4, 7)}

    sigmas = {}
    for depth_m, image in images.items():
        (seen,) = (
            await run_operator(
                KeypointDepth(config),
                features=[_features(_PX[:1])],
                depth=[replace(depth, image=image)],
            )
        )["features"]
        sigmas[depth_m] = np.where(np.isfinite(seen.points_m[:, 2]), seen.point_sigmas_m, np.nan)[0]

    assert sigmas[4] > 10 * sigmas[1]
    assert np.isnan(sigmas[7])


async def test_D18_without_depth_near_it_in_time_an_image_keeps_its_rays() -> None:
    run_context = Context()

    out = await run_operator(
        KeypointDepth(KeypointDepthConfig()),
        run_context=run_context,
        features=[_features()],
        depth=[replace(_depth(), stamp_ns=10**9)],
    )

    assert out["features"][0].points_m is None
    assert list(run_context.activity.warnings) == ["images of cam without depth within 20 ms"]


def test_depth_of_another_camera_is_refused() -> None:
    operator = KeypointDepth(KeypointDepthConfig())
    other = replace(_depth(), camera=camera("radtan", focal_px=np.array([130.0, 130.0])))
    small = replace(_depth(), image=_depth().image[::2, ::2])

    for depth in (other, small):
        with pytest.raises(OperatorError, match="is not registered to cam; put depth_registration"):
            operator.with_depth(_features(), depth)
