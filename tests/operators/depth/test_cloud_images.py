"""Organised clouds are as good as the images that they were made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from mapstream.operators.depth.cloud_images import CloudImages, CloudImagesConfig
from mapstream.operators.depth.grid_camera import grid_camera
from mapstream.operators.odometry.dense.dense_visual_odometry import (
    DenseVisualOdometry,
    DenseVisualOdometryConfig,
)
from mapstream.operators.odometry.rgbd.rgbd_odometry import RgbdOdometry, RgbdOdometryConfig
from mapstream.operators.operator import Context
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import DecodeError, EstimationError
from mapstream.streams.messages.sensors import CameraFrame, OrganizedCloud
from tests.operators.rgbd_views import RgbdView, views
from tests.recordings.decoding.made_ros import cloud as ros_cloud

pytestmark = pytest.mark.anyio
WIDTH_PX = 160
PCL = np.dtype({"names": ["x", "y", "z", "rgb"], "formats": ["<f4"] * 4, "offsets": [0, 4, 8, 16],
                "itemsize": 32})  # fmt: skip


def organized(view: RgbdView) -> OrganizedCloud:
    """Return what a driver makes of a view: points and colours of the same pixels."""
    camera = view.depth.camera
    assert camera is not None
    z = np.where(view.depth.image > 0, view.depth.image / 1000, np.nan)
    rows, columns = np.indices(z.shape)
    pixels = np.stack([columns, rows], axis=2)
    slopes = (pixels - camera.center_px) / camera.focal_px
    points = np.concatenate([slopes * z[:, :, None], z[:, :, None]], axis=2)
    return OrganizedCloud(
        stamp_ns=view.depth.stamp_ns,
        points=points.astype(np.float32),
        colors_rgb=np.repeat(view.color.image[:, :, None], 3, axis=2),
        frame="camera",
        T_base_sensor=view.depth.T_base_sensor,
    )


def positions(
    odometry: DenseVisualOdometry | RgbdOdometry,
    frames: Sequence[CameraFrame],
    depths: Sequence[CameraFrame],
) -> np.ndarray:
    found = [odometry.track(*pair) for pair in zip(frames, depths, strict=True)]
    assert not any(each.is_lost for each in found if each is not None)
    return np.array([each.T_odom_base.t for each in found if each is not None])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dense", "planes_and_edges"])
async def test_A7_trajectories_of_clouds_and_images_are_equal(kind: str) -> None:
    """Within 1 mm, with the calibration that the clouds themselves tell; and so are the calibrations."""
    seen = views(WIDTH_PX, 4.0, 6)
    out = await run_operator(
        CloudImages(CloudImagesConfig()), organized=[organized(view) for view in seen]
    )

    def fresh() -> DenseVisualOdometry | RgbdOdometry:
        if kind == "dense":
            return DenseVisualOdometry(DenseVisualOdometryConfig())
        return RgbdOdometry(RgbdOdometryConfig())

    of_images = positions(fresh(), [v.color for v in seen], [v.depth for v in seen])
    of_clouds = positions(fresh(), out["frames"], out["depth"])

    assert len(of_clouds) == len(seen)
    assert np.linalg.norm(of_images[-1] - of_images[0]) > 0.1
    np.testing.assert_allclose(of_clouds, of_images, atol=1e-3)
    (found, true) = (out["depth"][0].camera, seen[0].depth.camera)
    assert found is not None
    assert true is not None
    np.testing.assert_allclose(found.focal_px, true.focal_px, atol=1e-3)
    np.testing.assert_allclose(found.center_px, true.center_px, atol=1e-3)


@pytest.mark.parametrize("has_colors", [True, False])
async def test_A7_a_ros_recording_gives_organised_clouds(
    tmp_path: Path,
    has_colors: bool,  # noqa: FBT001
) -> None:
    """With holes, padding and packed colours as PCL writes them; other readers get a scan of what was seen."""
    (view,) = views(WIDTH_PX, 4.0, 1)
    cloud = organized(view)
    height, width, _ = cloud.points.shape
    points = np.zeros(height * width, PCL)
    for k, name in enumerate("xyz"):
        points[name] = cloud.points[:, :, k].ravel()
    assert cloud.colors_rgb is not None
    red, green, blue = (cloud.colors_rgb[:, :, k].ravel().astype(np.uint32) for k in range(3))
    points["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    kept = points if has_colors else points[["x", "y", "z"]]
    raw = ros_cloud("cdr", kept, height=height, width=width, row_step=32 * width, point_step=32)
    path = tmp_path / "clouds.mcap"
    with McapWriter(path) as writer:
        writer.write_raw(replace(raw.channel, topic="/points"), bytes(raw.data), raw.log_ns)
    config = McapSourceConfig(path=path, topics={"organized": "/points", "scans": "/points"})

    out = await run_operator(McapSource(config), config=config, run_context=Context())

    (found,), (scan,) = out["organized"], out["scans"]
    np.testing.assert_array_equal(found.points, cloud.points)
    assert len(scan.points) == np.isfinite(cloud.points[:, :, 2]).sum()
    if has_colors:
        np.testing.assert_array_equal(found.colors_rgb, cloud.colors_rgb)
    else:
        assert found.colors_rgb is None


def test_A7_a_cloud_in_one_row_is_no_image() -> None:
    points = np.zeros(5, PCL)
    raw = ros_cloud("cdr", points)
    with pytest.raises(DecodeError, match="5 points in 1 row: no organised cloud"):
        decoder_for(raw.channel, OrganizedCloud)(raw)


def test_points_that_are_no_pixels_are_refused() -> None:
    (view,) = views(WIDTH_PX, 4.0, 1)
    cloud = organized(view)
    shuffled = np.random.default_rng(0).permutation(cloud.points.reshape(-1, 3))

    with pytest.raises(EstimationError, match="px off the pixels of the pinhole that fits best"):
        grid_camera(shuffled.reshape(cloud.points.shape), "camera", 0.5)
    with pytest.raises(EstimationError, match="0 points, 100 are needed"):
        grid_camera(cloud.points * np.nan, "camera", 0.5)
    with pytest.raises(EstimationError, match="small part of the image"):
        grid_camera(np.where(np.arange(120)[:, None, None] < 12, cloud.points, np.nan), "camera", 1)


async def test_clouds_that_tell_no_calibration_are_counted_as_lost() -> None:
    (view,) = views(WIDTH_PX, 4.0, 1)
    cloud = organized(view)
    empty = replace(cloud, points=cloud.points * np.float32(np.nan))
    context = Context()

    out = await run_operator(
        CloudImages(CloudImagesConfig()), organized=[empty, cloud], run_context=context
    )

    assert len(out["depth"]) == len(out["frames"]) == 1
    assert sum(context.activity.losses.values()) == 1


def test_a_given_calibration_is_taken() -> None:
    (view,) = views(WIDTH_PX, 4.0, 1)
    config = CloudImagesConfig(focal_px=(100.0, 101.0), center_px=(80.0, 60.0))
    depth, _ = CloudImages(config).images(organized(view))

    assert depth.camera is not None
    np.testing.assert_array_equal(depth.camera.focal_px, [100, 101])
    with pytest.raises(ValidationError, match="both focal_px and center_px"):
        CloudImagesConfig(focal_px=(100.0, 100.0))
