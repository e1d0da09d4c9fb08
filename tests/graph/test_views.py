"""Each type of message is drawn without an error, and its drawing can be read back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from mapstream.graph import views
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.graph.views import Entry, Scene, ViewSettings, view_of
from mapstream.graph.views.ceiling import is_below_ceiling
from mapstream.graph.views.colors import ACCEPTED, REFUSED, switch_colors
from mapstream.graph.views.lidar import thinned
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.tables import Frames
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.sensors import LidarScan
from tests.graph import made_messages as made
from tests.graph.rrd import columns_of, read_rrd, strict, values_of


def drawn(path: Path, messages: Iterable[Any], scene: Scene | None = None) -> dict[str, list[Any]]:
    """Draw messages of the output `op/port` into a file, and read it back."""
    scene = scene or Scene()
    scene.path = "op/port"
    file = path / "drawn.rrd"
    sink = SinkSpec.parse(f"save={file}").open()
    with strict():
        assert sink.try_open(None)
        for sequence, message in enumerate(messages):
            drawing = view_of(message)(message, scene)
            sink.draw("op/port", drawing, stamp_ns=message.stamp_ns, sequence=sequence)
        assert sink.flush(10.0)
        sink.close()
    return read_rrd(file)


SENSORS = {
    "scans": {
        "/op/port": "Points3D:positions",
        "/frames/sensor\\:lidar": "Transform3D:translation",
    },
    "imu": {"/op/port/gyro": "Scalars:scalars", "/op/port/accel": "Scalars:scalars"},
    "laser": {"/op/port": "Points3D:positions"},
    "gnss": {"/op/port": "GeoPoints:positions"},
    "wheels": {"/frames/base": "Transform3D:mat3x3"},
    "tf": {"/op/port/os_lidar": "Transform3D:parent_frame"},
    "features": {"/op/port": "Points2D:positions"},
}


@pytest.mark.parametrize("name", SENSORS)
def test_P1_every_sensor_message_is_drawn(name: str, tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.sensor_messages()[name]])

    for entity, column in SENSORS[name].items():
        assert column in columns_of(entities[entity])
        assert {"stamp", "seq"} <= columns_of(entities[entity]) or entity.endswith("robot")


@pytest.mark.parametrize(
    ("encoding", "column"),
    [
        ("mono8", "Image:buffer"),
        ("bgr8", "Image:buffer"),
        ("rgb8", "Image:buffer"),
        ("16UC1", "DepthImage:buffer"),
        ("32FC1", "DepthImage:buffer"),
    ],
)
def test_every_encoding_of_an_image_is_drawn(encoding: str, column: str, tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.camera_frame(encoding)])

    assert column in columns_of(entities["/op/port"])


@pytest.mark.parametrize("encoding", ["mono8", "bgr8", "rgb8"])
def test_large_images_are_compressed(encoding: str, tmp_path: Path) -> None:
    scene = Scene(settings=ViewSettings(jpeg_above_bytes=100))

    entities = drawn(tmp_path, [made.camera_frame(encoding)], scene)

    assert values_of(entities["/op/port"], "EncodedImage:media_type") == [["image/jpeg"]]


def test_images_of_known_formats_are_drawn_as_recorded(tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.encoded_image("jpeg")])

    (blob,) = values_of(entities["/op/port"], "EncodedImage:blob")
    assert bytes(blob[0]) == made.encoded_image().data.tobytes()


def test_an_image_of_an_unknown_format_is_described(tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.encoded_image("h266")])

    assert "h266" in values_of(entities["/op/port/summary"], "TextDocument:text")[0][0]


def test_P1_odometry_moves_the_robot_and_leaves_a_trail(tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.odometry(step) for step in range(5)])

    places = values_of(entities["/frames/base"], "Transform3D:translation")
    np.testing.assert_allclose(places[-1][0], made.pose(4).t, atol=1e-5)
    assert values_of(entities["/frames/base"], "Transform3D:parent_frame")[0] == ["odom"]
    trail = values_of(entities["/op/port/trail"], "LineStrips3D:strips")
    assert len(trail[-1][0]) == 5


def test_P1_the_robot_in_a_finished_map_is_coloured_by_state(tmp_path: Path) -> None:
    poses = made.map_poses()

    entities = drawn(tmp_path, poses)

    robot = entities["/op/port/robot"]
    colors = [row[0] for row in values_of(robot, "Boxes3D:colors")]
    assert len(colors) == 4  # of the first nobody knows where it was
    assert colors[0] == colors[1] == ACCEPTED
    assert colors[2] == REFUSED | 0xFF
    assert colors[3] not in colors[:3]
    places = np.array(values_of(robot, "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(places[2], places[1])  # where it was last
    np.testing.assert_allclose(places[3], made.pose(4).t + np.array([0, 5, 0]), atol=1e-5)
    np.testing.assert_allclose(
        values_of(entities["/frames/odom"], "Transform3D:translation")[-1][0], [0, 5, 0]
    )
    assert {"/op/port/way/0/0", "/op/port/way/1/0", "/op/port/recovered/1"} <= set(entities)
    texts = [row[0] for row in values_of(entities["/op/port/log"], "TextLog:text")]
    assert texts[0].startswith("lost: 3 matches, which speak of no place")
    assert texts[4].startswith("recovered: accepted")


def test_odometry_that_lies_in_the_map_is_not_moved_again() -> None:
    scene = Scene(path="op/poses", main_odometry="op/odometry")

    for pose in made.map_poses():
        assert "/frames/odom" not in {entry.path for entry in view_of(pose)(pose, scene)}


def test_a_long_trail_is_drawn_in_stretches(tmp_path: Path) -> None:
    """With a message only its last stretch is logged, so that a run's file grows with its length."""
    entities = drawn(tmp_path, [made.odometry(step) for step in range(250)])

    stretches = {name for name in entities if "/uncorrected/" in name}
    assert len(stretches) == 3


def test_a_second_odometry_does_not_move_the_robot() -> None:
    scene = Scene(path="other/odometry", main_odometry="op/odometry")

    paths = [entry.path for entry in view_of(made.odometry(0))(made.odometry(0), scene)]

    assert set(paths) == {"uncorrected/0", "speed"}


def test_P1_submaps_are_drawn_in_their_own_frame(tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.submap(0), made.submap(1)])

    path = f"/map/submaps/{made.MISSION[:8]}"
    assert len(values_of(entities[f"{path}/0/cloud"], "Points3D:positions")[0]) == 4 * 50
    assert len(values_of(entities[f"{path}/1/cloud"], "Points3D:positions")[0]) == 3 * 50
    assert len(values_of(entities[f"{path}/0/edges"], "LineStrips3D:strips")[0]) == 3
    (place,) = values_of(entities[f"{path}/1"], "Transform3D:translation")
    np.testing.assert_allclose(place[0], made.pose(3).t, atol=1e-5)


def test_a_correction_moves_odometry_and_only_the_submaps_that_moved() -> None:
    scene = Scene(path="op/port")
    first = made.submap(0)
    list(view_of(first)(first, scene))

    same, shifted = made.correction(shift_m=0.0), made.correction(shift_m=2.0)
    moved_by_none = [e.path for e in view_of(same)(same, scene)]
    moved = [e.path for e in view_of(shifted)(shifted, scene)]

    submap = f"/map/submaps/{made.MISSION[:8]}/0"
    assert "/frames/odom" in moved_by_none
    assert submap not in moved_by_none
    assert submap in moved
    np.testing.assert_allclose(scene.T_map_odom.t, [0, 2, 0])


def test_P1_loops_are_drawn_by_verdict_and_said_why(tmp_path: Path) -> None:
    messages = [*(made.odometry(step) for step in range(4)), made.loop_report()]

    entities = drawn(tmp_path, messages)

    assert len(values_of(entities["/map/edges/loop"], "LineStrips3D:strips")[-1]) == 1
    assert len(values_of(entities["/op/port/refused"], "LineStrips3D:strips")[-1]) == 1
    texts = [row[0] for row in values_of(entities["/op/port/log"], "TextLog:text")]
    assert texts[0].startswith("accepted")
    assert texts[1].startswith("too few inliers")


def test_accepted_loops_follow_a_correction() -> None:
    scene = Scene(path="op/port")
    for message in (made.correction(), made.loop_report()):
        list(view_of(message)(message, scene))

    shifted = made.correction(shift_m=2.0)
    entries = {e.path: e for e in view_of(shifted)(shifted, scene) if isinstance(e, Entry)}

    strips = entries["/map/edges/loop"].archetypes[0].strips.as_arrow_array().to_pylist()
    np.testing.assert_allclose(strips[0][0], made.pose(0).t + np.array([0, 2, 0]), atol=1e-5)


def test_P1_a_map_is_drawn_with_its_loops_coloured_by_switch(tmp_path: Path) -> None:
    entities = drawn(tmp_path, [made.made_map()])

    mission = entities[f"/map/trajectory/{made.MISSION[:8]}"]
    assert len(values_of(mission, "LineStrips3D:strips")[0][0]) == 4
    assert values_of(entities["/map/edges/loop"], "LineStrips3D:colors") == [[ACCEPTED]]


def test_P1_switch_values_go_from_red_to_green() -> None:
    colors = switch_colors(np.array([0.0, 1.0, np.nan]))

    assert colors.tolist() == [REFUSED, ACCEPTED, REFUSED]


@dataclass(frozen=True)
class Reading:
    stamp_ns: int
    temperature_c: float
    name: str
    samples: Any


def test_a_message_of_an_unknown_type_is_plotted_and_described(tmp_path: Path) -> None:
    reading = Reading(stamp_ns=1, temperature_c=21.5, name="motor", samples=np.zeros((3, 2)))

    entities = drawn(tmp_path, [reading])

    assert values_of(entities["/op/port/temperature_c"], "Scalars:scalars") == [[21.5]]
    (text,) = values_of(entities["/op/port/summary"], "TextDocument:text")[0]
    assert "float64 (3, 2)" in text
    assert "'motor'" in text


@dataclass(frozen=True)
class Detections:
    stamp_ns: int


def view_detections(message: Detections, scene: Scene) -> list[Entry]:
    return [Entry.of("boxes", rr.Boxes2D(sizes=[[1, 1]]))]


def test_P2_a_plugin_draws_its_own_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"{Detections.__module__}.{Detections.__qualname__}"
    point = EntryPoint(name, f"{__name__}:view_detections", views.GROUP)
    monkeypatch.setattr(views, "entry_points", lambda **k: [point] if k["name"] == name else [])

    entries = list(view_of(Detections(stamp_ns=0))(Detections(stamp_ns=0), Scene()))

    assert [entry.path for entry in entries] == ["boxes"]


def test_a_scan_without_points_is_drawn(tmp_path: Path) -> None:
    empty = LidarScan(
        stamp_ns=0, points=np.zeros((0, 3), np.float32), intensity=np.zeros(0, np.float32)
    )

    entities = drawn(tmp_path, [empty])

    assert values_of(entities["/op/port"], "Points3D:positions") == [[]]


@pytest.mark.parametrize("count", [0, 1, 99, 100, 101, 1000])
def test_thinning_keeps_at_most_the_limit(count: int) -> None:
    points, intensity = thinned(np.zeros((count, 3), np.float32), np.zeros(count, np.float32), 100)

    assert len(points) <= 100
    assert intensity is not None
    assert len(intensity) == len(points) >= min(count, 50)


def test_a_ceiling_is_left_out_and_the_walls_stay() -> None:
    x, y = np.random.default_rng(1).uniform(-5, 5, (2, 1000))
    floor, ceiling = np.stack([x, y, 0 * x - 1], 1), np.stack([x, y, 0 * x + 3], 1)
    wall = np.stack([x, 0 * x + 5, np.linspace(-1, 3, 1000) ** 3 / 9], 1)

    room = np.concatenate([floor, wall, ceiling]).astype(np.float32)

    inside = room[is_below_ceiling(room, np.zeros((1, 3)))]
    outside = is_below_ceiling(room[: len(floor) + len(wall)], np.zeros((1, 3)))

    assert 1700 < len(inside) < 2000
    assert inside[:, 2].max() < 2.5
    assert outside.all()


def test_a_sensor_is_placed_again_only_when_it_moved() -> None:
    scene = Scene()

    drawings = [scene.mount("lidar", SE3.exp([0, 0, 0, x, 0, 0])) for x in (0.0, 0.0, 1.0)]

    assert [len(drawing) for drawing in drawings] == [1, 0, 1]


def test_positions_are_drawn_in_their_outer_frame_which_the_map_moves(tmp_path: Path) -> None:
    measured = Constraint(
        stamp_ns=1,
        kind="position",
        T_a_b=SE3.from_rotation(np.eye(3), [1, 2, 3]),
        outer=OuterFrame(name="enu"),
    )
    T_map_frame = SE3.from_rotation(np.eye(3), [10, 20, 30])
    frames = Frames(
        id=id_array([derived_id("frame", "enu")]),
        name=np.array(["enu"], dtype=object),
        T_map_frame=T_map_frame.matrix[None],
    )

    entities = drawn(tmp_path, [measured, replace(Map.empty(), frames=frames)])

    assert np.ravel(values_of(entities["/op/port/places/0"], "Points3D:positions")).tolist() == [
        *(1, 2, 3)
    ]
    moved = values_of(entities["/frames/outer\\:enu"], "Transform3D:translation")
    assert np.reshape(moved, (-1, 3)).tolist() == [[0, 0, 0], [10, 20, 30]]
