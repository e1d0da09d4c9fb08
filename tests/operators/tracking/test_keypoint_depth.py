"""Depth at keypoints: where it is known and smooth, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.keypoint_depth import KeypointDepth, KeypointDepthConfig
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures

pytestmark = pytest.mark.anyio
CAMERA = CameraCalibration(
    frame="camera",
    model="pinhole",
    width_px=64,
    height_px=48,
    focal_px=np.array([50.0, 50.0]),
    center_px=np.array([32.0, 24.0]),
    distortion_parameters=np.empty(0),
)


def keypoints(*px: tuple[float, float]) -> ImageFeatures:
    return ImageFeatures(
        stamp_ns=10,
        kind="klt",
        frame="camera",
        keypoints_px=np.array(px, np.float32),
        track_ids=np.arange(len(px)),
        camera=CAMERA,
    )


def depth(image: np.ndarray, encoding: str = "16UC1") -> CameraFrame:
    return CameraFrame(stamp_ns=10, image=image, encoding=encoding, frame="camera")


@pytest.mark.parametrize(("encoding", "scale"), [("16UC1", 1000), ("32FC1", 1)])
async def test_depth_becomes_points_along_the_rays(encoding: str, scale: int) -> None:
    image = np.full((48, 64), 2 * scale, np.uint16 if encoding == "16UC1" else np.float32)

    out = await run_operator(
        KeypointDepth(KeypointDepthConfig()),
        features=[keypoints((32, 24), (57, 24))],
        depth=[depth(image, encoding)],
    )

    (found,) = out["features"]
    np.testing.assert_allclose(found.points_m, [[0, 0, 2], [1, 0, 2]], atol=2e-3)
    np.testing.assert_allclose(found.point_sigmas_m[0], 0.012, rtol=1e-5)
    assert found.track_ids.tolist() == [0, 1]


async def test_edges_holes_and_borders_stay_rays() -> None:
    image = np.full((48, 64), 2000, np.uint16)
    image[:, 20:] = 3000  # an edge
    image[30:, :] = 0  # unknown
    image[:5, 40:] = 60000  # too far

    out = await run_operator(
        KeypointDepth(KeypointDepthConfig()),
        features=[keypoints((10, 10), (20, 10), (10, 40), (50, 2), (63, 10))],
        depth=[depth(image)],
    )

    (found,) = out["features"]
    assert np.isfinite(found.points_m[:, 2]).tolist() == [True, False, False, False, False]


async def test_without_depth_keypoints_pass() -> None:
    out = await run_operator(
        KeypointDepth(KeypointDepthConfig()), features=[keypoints((10, 10))], depth=[]
    )

    assert out["features"][0].points_m is None
