"""World W-RGBD: repeatable, colour and depth of the same pixels, and the table is seen twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.renderer import occluding_edges
from mapstream.recordings.worlds.w_rgbd import T_BASE_CAMERA, WRgbdConfig, rgbd_world, w_rgbd
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    OrganizedCloud,
    TransformBatch,
)
from mapstream.streams.sensors import CameraSensor

SMALL: dict[str, Any] = {
    "duration_s": 8.0,
    "camera": {"width_px": 160, "height_px": 120, "rate_hz": 1.0, "clouds": True},
    "texel_m": 0.02,
}


@pytest.fixture(scope="module")
def messages() -> list[Any]:
    """What one way round the room records, in order."""
    return [record.message for record in w_rgbd(WRgbdConfig.model_validate(SMALL), 0).records]


def of_type(messages: list[Any], kind: type[Any]) -> list[Any]:
    return [message for message in messages if isinstance(message, kind)]


def poses(messages: list[Any]) -> dict[int, np.ndarray]:
    """Return T_world_camera at the stamps of the truth."""
    truth = [m for m in of_type(messages, Odometry) if m.velocity_mps is not None]
    return {m.stamp_ns: (m.T_odom_base @ T_BASE_CAMERA).matrix for m in truth}


def test_R9_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (3, 3, 4), strict=True):
        simulate("w_rgbd", path, seed=seed, **SMALL | {"duration_s": 4.0})

    a, b, c = (path.read_bytes() for path in paths)
    assert a == b
    assert a != c
    with McapRecording(paths[0]) as recording:
        topics = {"/color/image", "/depth/image", "/points", "/imu", "/odometry"}
        assert set(recording.topics) == topics | {"/truth", "/truth/things"}
    rig = rig_of(paths[0])
    for name in ("color", "depth"):
        assert isinstance(rig.sensor_of_topic(f"/{name}/image"), CameraSensor)
        np.testing.assert_allclose(rig.T_base_sensor(name, 0).matrix, T_BASE_CAMERA.matrix)


def test_A7_clouds_are_the_depth_images(messages: list[Any]) -> None:
    """Pixel by pixel."""
    depths, clouds = of_type(messages, CameraFrame), of_type(messages, OrganizedCloud)
    assert len(depths) == len(clouds) == len(of_type(messages, EncodedImage)) == 9
    for depth, cloud in zip(depths, clouds, strict=True):
        seen = depth.image > 0
        assert depth.encoding == "16UC1"
        np.testing.assert_allclose(cloud.points[seen, 2], depth.image[seen] / 1000.0, atol=1e-6)
        assert np.isnan(cloud.points[~seen]).all()
        assert cloud.colors_rgb.shape == cloud.points.shape


def test_points_lie_on_the_surfaces_that_the_world_tells(messages: list[Any]) -> None:
    """To the noise of structured light: its axial deviation, which grows with the square of the depth."""
    world, at = rgbd_world(WRgbdConfig.model_validate(SMALL), 0), poses(messages)
    depth = of_type(messages, CameraFrame)[3]
    T = at[depth.stamp_ns]
    view = world.camera.ideal(T)
    seen = (depth.image > 0) & (view.surfaces >= 0)
    noise_m = depth.image[seen] / 1000.0 - 1 / view.inverse_depths[seen]
    sigma_m = 0.0012 + 0.0019 * (1 / view.inverse_depths[seen] - 0.4) ** 2

    assert seen.mean() > 0.8
    assert np.std(noise_m / sigma_m) == pytest.approx(1.0, abs=0.06)
    assert abs(np.mean(noise_m / sigma_m)) < 0.05
    cloud = of_type(messages, OrganizedCloud)[3]
    points = cloud.points[depth.image > 0] @ T[:3, :3].T + T[:3, 3]
    rows = view.surfaces[depth.image > 0]
    normals, origins = (
        np.stack([getattr(s, name) for s in world.room.surfaces]) for name in ("normal", "origin")
    )
    off_m = np.abs(((points - origins[rows]) * normals[rows]).sum(axis=1))
    assert np.quantile(off_m, 0.95) < 0.04


def test_the_table_and_its_things_are_seen_twice(messages: list[Any]) -> None:
    """At the start and at the end, and in the middle of the way the camera looks elsewhere."""
    world, at = rgbd_world(WRgbdConfig.model_validate(SMALL), 0), poses(messages)
    (things,) = of_type(messages, TransformBatch)
    assert len(set(things.children)) == 6
    assert set(things.children) == {thing.name for thing in world.room.things}
    stamps = [image.stamp_ns for image in of_type(messages, EncodedImage)]
    seen = []
    for stamp in stamps:
        rows = np.unique(world.camera.ideal(at[stamp]).surfaces)
        names = {world.room.surfaces[row].name for row in rows if row >= 0}
        seen.append(len(names & set(things.children)))
    assert min(seen[0], seen[-1]) >= 5
    assert min(seen) == 0


def test_colours_are_those_of_the_surfaces(messages: list[Any]) -> None:
    """The recorded image is the ideal one, but for softness, noise and compression; and it has corners."""
    world, at = rgbd_world(WRgbdConfig.model_validate(SMALL), 0), poses(messages)
    for image in of_type(messages, EncodedImage)[::4]:
        recorded = cv2.imdecode(image.data, cv2.IMREAD_COLOR)
        ideal = world.camera.ideal(at[image.stamp_ns]).image
        assert recorded is not None
        assert recorded.shape == (120, 160, 3)
        assert np.abs(recorded.astype(float) - cv2.GaussianBlur(ideal, (3, 3), 0.6)).mean() < 6


def test_occluding_edges_are_around_the_table(messages: list[Any]) -> None:
    """The rim of the table hides the floor; edges inside the table's top are none."""
    world, at = rgbd_world(WRgbdConfig.model_validate(SMALL), 0), poses(messages)
    view = world.camera.ideal(at[of_type(messages, EncodedImage)[0].stamp_ns])

    edges = occluding_edges(view, 0.1)

    rows = np.unique(view.surfaces[edges])
    names = {world.room.surfaces[row].name for row in rows}
    assert "table" in names
    assert "floor" not in names
    assert 0.005 < edges.mean() < 0.1
