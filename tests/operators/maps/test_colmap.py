"""Maps go to COLMAP's text models and come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.maps.colmap import colmap_map, colmap_model
from mapstream.operators.maps.export import ExportConfig, export_map
from mapstream.operators.maps.import_ import import_map
from mapstream.operators.maps.trajectory_map import ImportConfig
from mapstream.recordings.colmap import read_model
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.cameras import Camera, cameras_of, with_cameras
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.tables import Landmarks, Observations
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, Distortion
from mapstream.streams.camera_models import project
from mapstream.streams.errors import MapError, RecordingError
from mapstream.streams.geometry import SE3, invert
from tests.recordings.made_maps import line_map

DISTORTIONS: dict[str, tuple[Distortion, list[float]]] = {
    "left": ("radtan", [-0.1, 0.01, 1e-3, -1e-3]),
    "rear": ("equidistant", [0.01, -0.02, 0.003, 0.0]),
    "right": ("fov", [0.9]),
}


def seen_map(distortions: dict[str, tuple[Distortion, list[float]]] = DISTORTIONS) -> Map:
    """A map with exact observations of a wall by several cameras."""
    rng, map_ = np.random.default_rng(3), line_map(4)
    cameras = {
        name: Camera(
            calibration=CameraCalibration(
                frame=name,
                width_px=640,
                height_px=480,
                focal_px=np.array([400.0, 401.0]),
                center_px=np.array([320.0, 240.0]),
                distortion=distortion,
                distortion_parameters=np.array(parameters),
            ),
            T_base_sensor=SE3.exp([0.0, 0.1, 0.0, 0.0, 0.2 * number, 0.0]),
        )
        for number, (name, (distortion, parameters)) in enumerate(distortions.items())
    }
    points = np.column_stack([rng.uniform(-2, 2, (30, 2)), rng.uniform(9, 12, 30)])
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", n) for n in range(30)),
        kind=np.full(30, "sift", dtype=object),
        vertex=np.zeros(30, np.int64),
        p_base=(invert(map_.T_map_base(np.arange(1)))[0] @ np.c_[points, np.ones(30)].T).T[:, :3],
    )
    tables: list[tuple[int, int, str, FloatArray]] = []
    for vertex, T_map_base in enumerate(map_.T_map_base(np.arange(4))):
        for name, camera in cameras.items():
            T_camera_map = invert((T_map_base @ camera.T_base_sensor.matrix)[None])[0]
            px, _ = project(
                camera.calibration, points @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
            )
            tables += [(vertex, landmark, name, px[landmark]) for landmark in range(30)]
    observations = Observations(
        vertex=np.array([row[0] for row in tables]),
        landmark=np.array([row[1] for row in tables]),
        sensor=np.array([row[2] for row in tables], dtype=object),
        keypoint_px=np.array([row[3] for row in tables]),
    )
    map_ = replace(map_, landmarks=landmarks, observations=observations)
    return with_cameras(map_, 0, cameras)


def test_S3_a_map_comes_back_from_colmap_as_it_was(tmp_path: Path) -> None:
    map_ = seen_map()
    report = export_map(map_, tmp_path, tmp_path / "model.colmap", ExportConfig())
    again = import_map([tmp_path / "model.colmap"], ImportConfig())

    assert report.written == {"images": 12, "points": 30}
    assert check_map(again) == []
    assert again.vertices.stamp_ns.tolist() == map_.vertices.stamp_ns.tolist()
    rows = np.arange(30)
    np.testing.assert_allclose(
        again.T_map_landmark(rows)[:, :3, 3], map_.T_map_landmark(rows)[:, :3, 3], atol=1e-9
    )
    before, after = cameras_of(map_, 0), cameras_of(again, 0)
    for name, camera in before.items():
        np.testing.assert_allclose(
            again.T_map_base(np.arange(4)) @ after[name].T_base_sensor.matrix,
            map_.T_map_base(np.arange(4)) @ camera.T_base_sensor.matrix,
            atol=1e-9,
        )
        assert after[name].calibration.distortion == camera.calibration.distortion
        np.testing.assert_allclose(after[name].calibration.center_px, camera.calibration.center_px)
    table = again.observations
    order = np.lexsort((table.landmark, table.sensor.astype(str), table.vertex))
    seen = map_.observations
    expected = np.lexsort((seen.landmark, seen.sensor.astype(str), seen.vertex))
    np.testing.assert_allclose(table.keypoint_px[order], seen.keypoint_px[expected], atol=1e-4)


def test_S3_a_second_round_changes_nothing(tmp_path: Path) -> None:
    export_map(seen_map(), tmp_path, tmp_path / "a.colmap", ExportConfig())
    once = colmap_map(tmp_path / "a.colmap", ImportConfig())
    export_map(once, tmp_path, tmp_path / "b.colmap", ExportConfig())

    twice = colmap_map(tmp_path / "b.colmap", ImportConfig())

    np.testing.assert_allclose(
        twice.T_map_base(np.arange(4)), once.T_map_base(np.arange(4)), atol=1e-12
    )
    assert len(twice.landmarks) == len(once.landmarks) == 30


def test_S3_a_mirror_has_no_place_in_colmap_and_is_counted() -> None:
    map_ = seen_map()
    rear = cameras_of(map_, 0)["rear"]
    calibration = replace(rear.calibration, model="unified", xi=0.9)
    mirrored = with_cameras(map_, 0, {"rear": replace(rear, calibration=calibration)})

    model, left_out = colmap_model(mirrored)

    assert left_out == {"images of rear": 4}
    assert len(model.images) == 8


def test_models_of_colmap_itself_are_read(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# cameras\n1 SIMPLE_RADIAL 100 80 50 50.5 40.5 -0.1\n")
    (tmp_path / "images.txt").write_text(
        "# images\n1 1 0 0 0 0 0 0 1 a b.jpg\n10.5 20.5 7 30.5 40.5 -1\n"
        "2 1 0 0 0 -1 0 0 1 c.jpg\n\n"
    )
    (tmp_path / "points3D.txt").write_text("7 1 2 3 255 0 0 0.5 1 0\n")

    map_ = colmap_map(tmp_path, ImportConfig())

    assert check_map(map_) == []
    assert map_.vertices.T_mission_base[:, 0, 3].tolist() == [0.0, 1.0]
    assert map_.observations.keypoint_px.tolist() == [[10, 20], [30, 40]]
    assert map_.observations.landmark.tolist() == [0, -1]
    [camera] = cameras_of(map_, 0).values()
    assert camera.calibration.distortion_parameters.tolist() == [-0.1, 0, 0, 0]


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("cameras.txt", "1 MIRROR 100 80 50\n", "cameras.txt:1: not understood"),
        ("cameras.txt", "1 PINHOLE 100 80 50\n", "PINHOLE has 4 parameters, not 1"),
        ("images.txt", "1 1 0 0 0 0 0 0 2 a.jpg\n\n", "image a.jpg is of camera 2"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n1 1 9\n", "image a.jpg sees point 9"),
    ],
)
def test_a_model_that_is_wrong_is_refused_by_line(
    tmp_path: Path, file: str, text: str, reason: str
) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 80 50 50 50 40\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    (tmp_path / "points3D.txt").write_text("")
    (tmp_path / file).write_text(text)

    with pytest.raises(RecordingError, match=reason):
        read_model(tmp_path)


def test_a_map_without_images_says_so(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no images"):
        export_map(line_map(3), tmp_path, tmp_path / "x.colmap", ExportConfig())
