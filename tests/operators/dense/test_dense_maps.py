"""Maps made dense from what they refer to in recordings, against the room where they were recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import igl
import numpy as np
import pytest

from mapstream.operators.dense.depth_clouds import DepthCloudsConfig, depth_clouds
from mapstream.operators.dense.distance_field import FieldConfig, State, field_of_map
from mapstream.operators.dense.fusion import FusionConfig, fuse
from mapstream.operators.dense.image_export import ImageExportConfig, export_images
from mapstream.operators.dense.mesh import MeshConfig, make_mesh
from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.sinks.mesh import MeshSink, MeshSinkConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import Map, require_valid
from mapstream.recordings.mesh_files import read_mesh
from mapstream.recordings.worlds.rgbd_room import rgbd_room
from mapstream.recordings.worlds.w_rgbd import T_BASE_CAMERA
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from tests.operators.dense.recorded_room import SIZE, true_map, write_recording

VOXEL_M = 0.04


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Map, Path]:
    folder = tmp_path_factory.mktemp("room")
    write_recording(folder / "room.mcap")
    return true_map(folder / "room.mcap"), folder


def away_m(points: Float32Array) -> FloatArray:
    """Return how far points are from the nearest surface of the room."""
    corners, faces, count = [], [], 0
    for surface in rgbd_room(0, texel_m=0.1).surfaces:
        corners.append(surface.points(surface.polygon))
        number = len(surface.polygon)
        faces += [[count, count + i, count + i + 1] for i in range(1, number - 1)]
        count += number
    squared, _, _ = igl.point_mesh_squared_distance(
        points.astype(np.float64), np.concatenate(corners), np.array(faces)
    )
    return np.asarray(np.sqrt(squared), np.float64)


def test_O3_O8_the_mesh_of_a_map_lies_on_the_surfaces_of_the_room(
    room: tuple[Map, Path], tmp_path: Path
) -> None:
    """RMS below 1.5 cm at noisy depth of 200 x 150 px up to 4 m, voxels of 4 cm; with the room's colours."""
    map_, folder = room

    report = make_mesh(
        map_,
        folder,
        tmp_path / "room.glb",
        MeshConfig(voxel_size_m=VOXEL_M, min_weight=0.1, min_part_faces=30),
    )

    mesh = read_mesh(tmp_path / "room.glb")
    assert report.fused.num_views == len(map_.vertices)
    assert not report.fused.left_out
    assert np.sqrt((away_m(mesh.vertices) ** 2).mean()) < 0.015
    assert mesh.rgb is not None
    assert np.ptp(mesh.rgb, axis=0).min() > 100


def test_O8_missions_whose_place_is_a_guess_are_left_out(room: tuple[Map, Path]) -> None:
    """Unless they are asked for."""
    map_, folder = room
    missions = replace(map_.missions, is_base_frame_known=np.array([False]))
    guessed = replace(map_, missions=missions)

    with pytest.raises(MapError, match="set with_unanchored=true"):
        fuse(guessed, folder, FusionConfig(voxel_size_m=0.2))
    _, report = fuse(guessed, folder, FusionConfig(voxel_size_m=0.2, with_unanchored=True))

    assert report.num_views == len(map_.vertices)


def test_O8_optimised_poses_move_the_surface(room: tuple[Map, Path]) -> None:
    """The volume of a map that was moved by a metre is the same, a metre away."""
    map_, folder = room
    moved = map_.missions.T_map_mission.copy()
    moved[0, 0, 3] += 8 * 0.2
    there = replace(map_, missions=replace(map_.missions, T_map_mission=moved))
    config = FusionConfig(voxel_size_m=0.2, has_colors=False)

    here_, there_ = (fuse(each, folder, config)[0] for each in (map_, there))

    np.testing.assert_array_equal(there_.blocks - here_.blocks, [[1, 0, 0]] * len(here_))


def test_O5_the_air_of_the_room_is_free_and_its_walls_are_not(room: tuple[Map, Path]) -> None:
    """At points that the camera looked through, distances are those to the room."""
    map_, folder = room
    field, report = field_of_map(map_, folder, FieldConfig(voxel_size_m=0.1))

    points = np.array([[x, y, 1.2] for x in (-0.6, 0.0, 0.6) for y in (-0.4, 0.4)])

    assert (field.states(points) == State.FREE).all()
    np.testing.assert_allclose(field.distances(points), away_m(points.astype(np.float32)), atol=0.1)
    assert report.num_voxels["occupied"] > 1000


def test_O7_depth_images_become_clouds_of_the_map(room: tuple[Map, Path]) -> None:
    """One at each vertex, in the base frame, with colours; where there is one it stays."""
    map_, folder = room

    dense, report = depth_clouds(map_, folder, DepthCloudsConfig())
    again, kept = depth_clouds(dense, folder, DepthCloudsConfig())

    require_valid(dense)
    cloud = aggregate_cloud(dense, folder, AggregateConfig(voxel_size_m=0.05))
    assert report.num_clouds == len(map_.vertices)
    assert cloud.colors_rgba is not None
    assert np.sqrt((away_m(cloud.points) ** 2).mean()) < 0.03
    assert (kept.num_clouds, kept.num_kept) == (0, len(map_.vertices))
    assert again.digest() == dense.digest()


def test_O7_images_are_exported_with_the_poses_of_their_cameras(
    room: tuple[Map, Path], tmp_path: Path
) -> None:
    """The table has a line per image, and its poses are those of the cameras in the map."""
    map_, _ = room

    report = export_images(map_, tmp_path / "out", ImageExportConfig())

    lines = (tmp_path / "out/poses.csv").read_text().splitlines()
    assert report.num_images == {"color": len(map_.vertices), "depth": len(map_.vertices)}
    assert len(lines) == 1 + 2 * len(map_.vertices)
    stamp_ns, camera, file, *pose = lines[-1].split(",")
    values = [float(number) for number in pose]
    found = SE3.from_quat_xyzw(values[3:], values[:3])
    expected = SE3(map_.T_map_base(np.array([-1]))[0]) @ T_BASE_CAMERA
    np.testing.assert_allclose(found.matrix, expected.matrix, atol=1e-6)
    assert int(stamp_ns) == map_.vertices.stamp_ns[-1]
    image = cv2.imread(str(tmp_path / "out" / file), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape[:2] == (SIZE["height_px"], SIZE["width_px"])
    assert camera in ("color", "depth")
    with pytest.raises(MapError, match="not empty"):
        export_images(map_, tmp_path / "out", ImageExportConfig())


def test_O7_pmvs_finds_points_of_the_room_where_its_projections_put_them(
    room: tuple[Map, Path], tmp_path: Path
) -> None:
    """A measured point, projected as the file says, falls onto the pixel that measured it."""
    map_, _ = room

    export_images(map_, tmp_path / "pmvs", ImageExportConfig(form="pmvs"))

    text = (tmp_path / "pmvs/txt/00000000.txt").read_text().splitlines()
    projection = np.array([line.split() for line in text[1:]], np.float64)
    assert text[0] == "CONTOUR"
    assert len(list((tmp_path / "pmvs/visualize").glob("*.jpg"))) == len(map_.vertices)
    assert (tmp_path / "pmvs/option.txt").exists()
    T_map_camera = map_.T_map_base(np.array([0]))[0] @ T_BASE_CAMERA.matrix
    ahead = T_map_camera @ np.array([0.1, 0.2, 2.0, 1.0])
    px = projection @ ahead
    focal = SIZE["width_px"] * 525 / 640
    center = (np.array([SIZE["width_px"], SIZE["height_px"]]) - 1) / 2
    np.testing.assert_allclose(px[:2] / px[2], center + focal * np.array([0.05, 0.1]), atol=1e-6)


@pytest.mark.anyio
async def test_O8_a_run_leaves_a_mesh(room: tuple[Map, Path], tmp_path: Path) -> None:
    """Of the last map that came."""
    map_, _ = room
    config = MeshSinkConfig(path=tmp_path / "mesh.ply", voxel_size_m=0.1)

    await run_operator(MeshSink(config), maps=[map_])

    assert len(read_mesh(tmp_path / "mesh.ply").faces) > 1000
