"""Depth of rendered stereo pairs, against the rendered depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.dense.fusion import FusionConfig, fuse
from mapstream.operators.dense.stereo_depth import StereoDepthConfig, StereoMatcher, stereo_depth
from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.maps import Map, require_valid
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.renderer import Pinhole, Renderer
from mapstream.recordings.worlds.surfaces import Surface, rectangle
from mapstream.streams.arrays import Float32Array
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, Odometry
from mapstream.streams.messages.sensors import CameraFrame, RecordRef
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor
from tests.operators.dense.recorded_room import drive

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 240, 160, 220.0, 0.3
PLACES = {"left": SE3.identity(), "right": SE3.from_rotation(np.eye(3), [BASELINE_M, 0, 0])}


def scene() -> list[Surface]:
    """A wall at 5 m with a board at 3 m before it; the cameras look along z."""
    rng = np.random.default_rng(0)

    def paint(size_m: tuple[float, float]) -> Picture:
        painter = Painter(rng, 0.01, is_colored=False)
        picture = painter.blank(size_m, painter.color(150, 0))
        painter.leaves(picture, round(60 * size_m[0] * size_m[1]), (0.02, 0.3))
        painter.plaster(picture, 25)
        return picture

    wall = rectangle("wall", [-5, -4, 5], [10, 0, 0], [0, 8, 0], paint, is_shell=True)
    board = rectangle("board", [-0.4, -0.5, 3], [1.2, 0, 0], [0, 0.9, 0], paint)
    return [wall, board]


def camera(name: str) -> CameraCalibration:
    return CameraCalibration(
        frame=name,
        width_px=WIDTH,
        height_px=HEIGHT,
        focal_px=np.full(2, FOCAL_PX),
        center_px=np.array([WIDTH - 1, HEIGHT - 1]) / 2,
        distortion_parameters=np.empty(0),
    )


@pytest.fixture(scope="module")
def pair() -> tuple[CameraFrame, CameraFrame, Float32Array]:
    """The left and the right image, and the depths of the left one [m]."""
    renderer = Renderer(scene())
    lens = Pinhole((FOCAL_PX, FOCAL_PX), ((WIDTH - 1) / 2, (HEIGHT - 1) / 2), (WIDTH, HEIGHT))
    frames = []
    depth_m = np.empty((0, 0), np.float32)
    for name in ("right", "left"):
        place = PLACES[name]
        view = renderer.rendering(lens, place.matrix)
        depth_m = np.reciprocal(view.inverse_depths)
        image = np.ascontiguousarray(view.image.reshape(HEIGHT, WIDTH, -1)[:, :, 0])
        frames.append(
            CameraFrame(
                stamp_ns=1000,
                image=image,
                encoding="mono8",
                frame=name,
                T_base_sensor=place,
                camera=camera(name),
            )
        )
    return frames[1], frames[0], depth_m


def test_O6_depth_of_a_wall_at_5_m_is_true_to_2_percent(
    pair: tuple[CameraFrame, CameraFrame, Float32Array],
) -> None:
    """Of nine pixels in ten; half of them to 1.2 percent (0.16 px); most pixels have a depth."""
    left, right, true_m = pair

    depth = StereoMatcher(StereoDepthConfig()).depth(left, right)

    found_m = depth.image / 1000
    error = np.abs(found_m / true_m - 1)[(found_m > 0) & (true_m > 4.9)]
    assert np.quantile(error, 0.9) < 0.02
    assert np.median(error) < 0.012
    assert (found_m > 0).mean() > 0.7


def recorded_pair(pair: tuple[CameraFrame, CameraFrame, Float32Array], path: Path) -> Map:
    """Record the pair, and return a map with two vertices, both of which refer to it."""
    sensors = [
        CameraSensor(id=f"{number}" * 32, topic=f"/{name}", frame=name, calibration=camera(name))
        for number, name in enumerate(PLACES, start=1)
    ]
    places = [
        Extrinsics(sensor_id=sensor.id, base_sensor_id=sensors[0].id, T_base_sensor=place)
        for sensor, place in zip(sensors, PLACES.values(), strict=True)
    ]
    with McapWriter(path) as writer:
        attach_rig(writer, Rig(sensors, places))
        for frame in pair[:2]:
            writer.write(f"/{frame.frame}", frame)
    records = tuple(RecordRef(path=str(path), topic=f"/{n}", log_ns=1000) for n in PLACES)
    frames = [
        Keyframe(
            stamp_ns=stamp_ns,
            odometry=Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity()),
            records=records,
        )
        for stamp_ns in (1000, 2000)
    ]
    return append_submap(Map.empty(), drive(frames), mission_name="pair")


def test_O6_stereo_depth_becomes_resources_of_the_map(
    pair: tuple[CameraFrame, CameraFrame, Float32Array], tmp_path: Path
) -> None:
    """Doing it twice leaves one depth image per vertex; they fuse to the wall and the board."""
    map_ = recorded_pair(pair, tmp_path / "pair.mcap")

    once, report = stereo_depth(map_, tmp_path, StereoDepthConfig())
    twice, _ = stereo_depth(once, tmp_path, StereoDepthConfig())

    require_valid(once)
    assert report.num_images == 2
    assert twice.digest() == once.digest()
    config = FusionConfig(voxel_size_m=0.1, max_range_m=8)
    volume, fused = fuse(once, tmp_path, config)
    assert (fused.source, fused.num_views) == ("depth", 2)
    assert len(volume) > 50


def test_a_map_without_pairs_says_so(
    pair: tuple[CameraFrame, CameraFrame, Float32Array], tmp_path: Path
) -> None:
    map_ = recorded_pair(pair, tmp_path / "pair.mcap")
    one = map_.select(resources=map_.resources.topic == "/left")

    with pytest.raises(MapError, match=r"no vertex refers to images of two cameras \(2 to fewer\)"):
        stereo_depth(one, tmp_path, StereoDepthConfig())
