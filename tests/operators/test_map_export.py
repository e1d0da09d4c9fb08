"""Maps go out in the formats of other tools, and come in."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from mapstream.operators.maps.export import EXPORTERS, ExportConfig, export_map
from mapstream.operators.maps.import_ import import_map
from mapstream.operators.maps.trajectory_map import ImportConfig
from mapstream.recordings.cloud_files import read_pcd, read_ply
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.las_files import read_las
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.build import add_resources, anchored, append_edges
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.tables import Edges, Frames
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry, PointCloud, RelativePose
from tests.recordings.made_maps import MISSION, OTHER_MISSION, full_map, line_map

CONFIG = ExportConfig(voxel_size_m=0.5)


def placed_map() -> Map:
    """A map whose mission frame is not the map frame."""
    return anchored(full_map(), 0, SE3.exp([0.1, 0.2, 0.3, 10.0, 20.0, 30.0]))


def map_with_clouds(folder: Path) -> Map:
    points = np.random.default_rng(0).uniform(-5, 5, (300, 3)).astype(np.float32)
    colors = np.full((300, 4), [200, 100, 50, 255], np.uint8)
    with CloudStore(folder / "clouds") as store:
        cloud = PointCloud(stamp_ns=0, points=points, intensity=points[:, 2], colors_rgba=colors)
        store.put("c", cloud)
    return add_resources(
        placed_map(), vertex_rows=np.array([0]), kind="cloud", paths=["clouds/c.arrow"]
    )


@pytest.mark.parametrize("suffix", [".tum", ".csv"])
def test_M12_a_trajectory_comes_back_exactly(suffix: str, tmp_path: Path) -> None:
    map_ = placed_map()
    path = tmp_path / f"drive{suffix}"

    report = export_map(map_, tmp_path, path, CONFIG)
    again = import_map([path], ImportConfig())

    assert report.files == (path,)
    assert report.written == {"poses": 6}
    np.testing.assert_array_equal(again.vertices.stamp_ns, map_.vertices.stamp_ns)
    poses = map_.T_map_base(np.arange(6))
    np.testing.assert_allclose(again.vertices.T_mission_base, poses, atol=1e-9)
    assert check_map(again) == []
    assert again.edges.kind.tolist() == ["odometry"] * 5


def test_S3_kitti_poses_are_those_of_the_map_frame(tmp_path: Path) -> None:
    map_ = placed_map()

    export_map(map_, tmp_path, tmp_path / "drive.kitti", CONFIG)

    again = import_map([tmp_path / "drive.kitti"], ImportConfig())
    poses = map_.T_map_base(np.arange(6))
    np.testing.assert_allclose(again.vertices.T_mission_base, poses, atol=1e-9)


def test_each_mission_gets_a_trajectory_of_its_own(tmp_path: Path) -> None:
    merged = merge_maps([full_map(), line_map(4, OTHER_MISSION)])

    report = export_map(merged, tmp_path, tmp_path / "all.tum", CONFIG)

    assert [file.name for file in report.files] == [
        f"all-{mission[:8]}.tum" for mission in (MISSION, OTHER_MISSION)
    ]
    assert len(import_map([report.files[1]], ImportConfig()).vertices) == 4


def test_S3_a_pose_graph_says_what_it_leaves_out(tmp_path: Path) -> None:
    report = export_map(placed_map(), tmp_path, tmp_path / "drive.g2o", CONFIG)

    assert report.written == {"poses": 6, "edges": 5}
    assert report.left_out == {"imu": 5, "absolute": 1}
    assert len(import_map([tmp_path / "drive.g2o"], ImportConfig()).edges) == 5


def test_O2_S3_clouds_are_written_in_the_map_frame(tmp_path: Path) -> None:
    map_ = map_with_clouds(tmp_path)

    ply = export_map(map_, tmp_path, tmp_path / "map.ply", CONFIG)
    pcd = export_map(map_, tmp_path, tmp_path / "map.pcd", CONFIG)

    assert ply.written == pcd.written
    T_map_base = map_.T_map_base(np.array([0]))[0]
    for cloud in (read_ply(tmp_path / "map.ply"), read_pcd(tmp_path / "map.pcd")):
        assert len(cloud.points) == ply.written["points"]
        assert cloud.intensity is not None
        np.testing.assert_allclose(cloud.points.mean(axis=0), T_map_base[:3, 3], atol=0.7)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_S3_las_keeps_points_and_colours_of_a_map_without_a_place_on_earth(
    suffix: str, tmp_path: Path
) -> None:
    map_ = map_with_clouds(tmp_path)
    export_map(map_, tmp_path, tmp_path / "map.ply", CONFIG)
    export_map(map_, tmp_path, tmp_path / f"map{suffix}", CONFIG)

    cloud, as_ply = read_las(tmp_path / f"map{suffix}"), read_ply(tmp_path / "map.ply")

    assert cloud.crs == ""
    np.testing.assert_allclose(cloud.points, as_ply.points, atol=0.00051)
    assert cloud.colors_rgb is not None
    assert cloud.colors_rgb.tolist() == [[200, 100, 50]] * len(cloud.points)


def test_O10_a_map_with_satellites_lies_in_utm_within_a_centimetre(tmp_path: Path) -> None:
    map_ = map_with_clouds(tmp_path)
    origin_lla = np.array([47.3769, 8.5417, 450.0])
    turn = SE3.from_rotation(so3_exp([0.0, 0.0, 0.7]), [120.0, -40.0, 3.0])  # T_map_frame
    frames = Frames(
        id=np.zeros((1, 16), np.uint8), name=np.array(["enu"], dtype=object),
        T_map_frame=turn.matrix[None], is_known=np.array([True]),
        crs=np.array(["enu"], dtype=object), origin_lla=origin_lla[None],
    )  # fmt: skip
    map_ = replace(map_, frames=frames)
    export_map(map_, tmp_path, tmp_path / "map.ply", CONFIG)

    export_map(map_, tmp_path, tmp_path / "map.laz", CONFIG)

    cloud = read_las(tmp_path / "map.laz")
    points = read_ply(tmp_path / "map.ply").points.astype(np.float64)
    in_enu = (points - turn.t) @ turn.R  # R^T p
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978").transform
    east, north = np.radians(origin_lla[1]), np.radians(origin_lla[0])
    se, ce, sn, cn = np.sin(east), np.cos(east), np.sin(north), np.cos(north)
    axes = np.array([[-se, -sn * ce, cn * ce], [ce, -sn * se, cn * se], [0, cn, sn]])
    ecef = np.array(to_ecef(*origin_lla)) + in_enu @ axes.T
    expected = np.column_stack(Transformer.from_crs("EPSG:4978", "EPSG:32632").transform(*ecef.T))
    assert "UTM zone 32N" in cloud.crs
    np.testing.assert_allclose(cloud.points[:, :2], expected[:, :2], atol=0.01)
    config, nowhere = ExportConfig(crs="EPSG:32632"), map_with_clouds(tmp_path)
    with pytest.raises(MapError, match="never saw a satellite"):
        export_map(nowhere, tmp_path, tmp_path / "map.las", config)


def test_S6_poses_and_edges_go_into_a_recording(tmp_path: Path) -> None:
    map_ = placed_map()

    report = export_map(map_, tmp_path, tmp_path / "drive.mcap", CONFIG)

    assert report.written == {"poses": 6, "edges": 5}
    assert report.left_out == {"imu": 5, "absolute": 1}
    with open_recording(tmp_path / "drive.mcap") as recording:
        decoders = {name: decoder_for(topic.channel) for name, topic in recording.topics.items()}
        messages = [decoders[raw.topic](raw) for raw in recording.messages()]
    poses = [m for m in messages if isinstance(m, Odometry)]
    edges = [m for m in messages if isinstance(m, RelativePose)]
    np.testing.assert_allclose(
        [pose.T_odom_base.matrix for pose in poses], map_.T_map_base(np.arange(6)), atol=1e-12
    )
    np.testing.assert_array_equal([pose.stamp_ns for pose in poses], map_.vertices.stamp_ns)
    np.testing.assert_allclose([edge.T_a_b.matrix for edge in edges], map_.edges.T_a_b[:5])


def test_unknown_formats_are_refused(tmp_path: Path) -> None:
    known = r"known are \.tum, \.kitti, \.csv, \.g2o, \.colmap, \.ply, \.pcd, \.las, \.laz, \.mcap, \.geojson"
    with pytest.raises(MapError, match=rf"map\.e57: unknown format '\.e57'; {known}"):
        export_map(full_map(), tmp_path, tmp_path / "map.e57", CONFIG)
    with pytest.raises(
        MapError, match=r"unknown format '\.bag'; known are suffixes \.tum, \.kitti"
    ):
        import_map([tmp_path / "drive.bag"], ImportConfig())


@pytest.mark.parametrize("suffix", [s for s in EXPORTERS if s not in (".g2o", ".mcap", "")])
def test_an_empty_map_has_nothing_to_write(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"no poses to write|no clouds|has no images|no objects"):
        export_map(Map.empty(), tmp_path, tmp_path / f"map{suffix}", CONFIG)

    assert not list(tmp_path.iterdir())


def with_every_edge() -> Map:
    """A map with edges on landmarks, between landmarks, with one end, and of a kind that nobody knows."""
    more = Edges(
        kind=np.array(["landmark", "parallel", "gravity", "fixed", "sonar"], dtype=object),
        vertex_a=np.array([0, -1, 1, -1, 2]),
        vertex_b=np.array([-1, -1, -1, -1, 4]),
        landmark_a=np.array([0, 1, -1, 2, -1]),
        landmark_b=np.array([-1, 2, -1, -1, -1]),
        covariance=np.tile(np.eye(6), (5, 1, 1)),
    )
    return append_edges(placed_map(), more)


@pytest.mark.parametrize("suffix", [".g2o", ".mcap"])
def test_M12_edges_that_a_format_has_no_place_for_are_left_out_and_counted(
    suffix: str, tmp_path: Path
) -> None:
    report = export_map(with_every_edge(), tmp_path, tmp_path / f"map{suffix}", CONFIG)

    assert report.written == {"poses": 6, "edges": 5}
    expected = {"imu": 5, "absolute": 1, "landmark": 1, "parallel": 1, "gravity": 1, "fixed": 1, "sonar": 1}  # fmt: skip
    assert report.left_out == expected


def read_csv(file: Path) -> list[dict[str, str]]:
    with file.open() as lines:
        return list(csv.DictReader(lines))


def test_M12_tables_hold_every_number_exactly(tmp_path: Path) -> None:
    map_ = with_every_edge()

    report = export_map(map_, tmp_path, tmp_path / "tables", CONFIG)

    assert report.written == {
        "missions": 1, "vertices": 6, "edges": 16, "landmarks": 4, "observations": 5, "imu": 15,
        "objects": 1, "regions": 3,
    }  # fmt: skip
    assert set(report.files) == set((tmp_path / "tables").iterdir())
    vertices = read_csv(tmp_path / "tables" / "vertices.csv")
    poses = map_.T_map_base(np.arange(6))
    found = [[float(row[f"{axis}_m"]) for axis in "xyz"] for row in vertices]
    np.testing.assert_array_equal(found, poses[:, :3, 3])
    speed = [np.linalg.norm([float(row[f"v{a}_mps"]) for a in "xyz"]) for row in vertices]
    np.testing.assert_allclose(speed, 2.0)
    assert vertices[0]["gyro_bias_x_radps"] == "nan"
    imu = read_csv(tmp_path / "tables" / "imu.csv")
    assert [float(row["accel_z_mps2"]) for row in imu] == [9.81] * 15
    assert {row["mission"] for row in imu} == {MISSION}
    landmarks = read_csv(tmp_path / "tables" / "landmarks.csv")
    assert landmarks[3]["label"] == "chair"
    assert [int(row["num_observations"]) for row in landmarks] == [2, 0, 1, 1]
    edges = read_csv(tmp_path / "tables" / "edges.csv")
    assert (edges[0]["sigma_x_m"], edges[10]["frame"]) == ("0.1", "enu")
    [mission] = read_csv(tmp_path / "tables" / "missions.csv")
    assert (mission["name"], mission["sensors"]) == ("line", "{}")


def test_M12_an_empty_map_gives_headers(tmp_path: Path) -> None:
    export_map(Map.empty(), tmp_path, tmp_path / "tables", CONFIG)

    assert (tmp_path / "tables" / "vertices.csv").read_text().startswith('"vertex","mission"')
    assert read_csv(tmp_path / "tables" / "imu.csv") == []
