"""Demos run on data that every machine has, and say how good their maps are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.cli.dataset_cache import converted
from mapstream.graph.cli.demo_judges import against_end_of_v101
from mapstream.graph.unused_positions import unused_position_errors
from mapstream.recordings.cache import cache_folder
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.ids import derived_id, id_array, mission_id
from mapstream.recordings.maps.model import vertex_ids
from mapstream.recordings.maps.tables import Edges, Frames, Vertices
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import EstimationError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from tests.data import shared
from tests.graph.terminal import Terminal

SECOND = 1_000_000_000
T_MAP_GPS = SE3.from_quat_xyzw([0, 0, 1, 1], [100, 0, 0])


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "mapstream"


def test_an_installed_data_set_is_converted_once(cache: Path) -> None:
    made = converted("kitti00-gtsam")
    time_ns = made.stat().st_mtime_ns

    again = converted("kitti00-gtsam")

    assert again == made
    assert again.stat().st_mtime_ns == time_ns
    assert [path.name for path in cache.iterdir()] == [made.name], "nothing is left over"


def test_a_cache_that_cannot_be_written_is_named(cache: Path) -> None:
    cache.parent.mkdir()
    cache.write_text("a file where the folder should be")

    with pytest.raises(RecordingError, match=r"mapstream: cannot be written.*set XDG_CACHE_HOME"):
        converted("kitti00-gtsam")


def test_the_cache_is_in_the_home_unless_the_environment_says_where(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for value in ("", "relative/paths/do/not/count"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)

        assert cache_folder() == Path.home() / ".cache" / "mapstream"


def straight_map(*used_s: int) -> Map:
    """A mission that drives along x at 1 m/s for ten seconds, with positions used at some seconds."""
    stamps_ns = np.arange(11) * SECOND
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = np.arange(11)
    mission = mission_id("drive")
    vertices = Vertices(
        id=vertex_ids(mission, stamps_ns),
        mission=np.zeros(11, dtype=np.int64),
        stamp_ns=stamps_ns,
        T_mission_base=poses,
    )
    frames = Frames(
        id=id_array([derived_id("frame", "gps")]),
        name=np.array(["gps"], dtype=object),
        T_map_frame=T_MAP_GPS.matrix[None],
    )
    map_ = replace(new_mission(Map.empty(), mission), vertices=vertices, frames=frames)
    num = len(used_s)
    edges = Edges(
        kind=np.full(num, "position", dtype=object),
        vertex_a=np.array(used_s, dtype=np.int64),
        frame=np.zeros(num, dtype=np.int64),
    )
    return append_edges(map_, edges)


def recorded(file: Path, name: str = "gps", *, off_m: float = 0.0) -> Path:
    """Positions every half second for twelve seconds, beside the drive by some metres."""
    with McapWriter(file) as writer:
        for half in range(25):
            p_gps = T_MAP_GPS.inverse() @ np.array([half / 2, off_m, 0.0])
            position = Constraint(
                stamp_ns=half * SECOND // 2,
                kind="position",
                T_a_b=SE3.from_rotation(np.eye(3), p_gps),
                outer=OuterFrame(name=name),
            )
            writer.write("/gps", position)
    return file


def test_a_map_is_judged_by_the_positions_it_did_not_use(tmp_path: Path) -> None:
    """Carried into the map by the frame that it found; those outside its time do not count."""
    file = recorded(tmp_path / "drive.mcap", off_m=2.0)

    found = unused_position_errors(straight_map(0, 5, 10), file)

    assert (found.num_used, found.distance_m.count) == (3, 18)
    assert found.distance_m.rmse == pytest.approx(2.0)
    assert found.length_m == pytest.approx(9.0)


def test_a_map_that_used_all_positions_cannot_be_judged(tmp_path: Path) -> None:
    file = recorded(tmp_path / "drive.mcap", name="another frame")

    with pytest.raises(EstimationError, match="no position is left to judge by: of 0 in frames"):
        unused_position_errors(straight_map(0), file)


@pytest.mark.slow
def test_demo_euroc_maps_a_real_drone_within_10_cm(mapstream: Terminal, tmp_path: Path) -> None:
    """Feature tracks of one camera and an IMU, 30 s, against the re-estimated truth."""
    truth = shared("euroc_v101_stereo_imu") / "gt_V1_01_easy_openvins.csv"

    done = mapstream(
        "demo", "euroc", "--out", tmp_path, "--rerun", "off", "--truth", truth, "--json"
    )

    assert done.code == 0, done.err
    judgement = done.json["judgement"]
    assert judgement["against"] == "the truth"
    assert judgement["distance_m"]["rmse"] < 0.1
    assert judgement["length_m"] > 7
    assert done.json["violations"] == []


def test_without_truth_the_drone_is_judged_by_where_it_ends(tmp_path: Path) -> None:
    save_map(straight_map(), tmp_path)

    judgement = against_end_of_v101(tmp_path, tmp_path)

    assert judgement.distance_m.rmse == pytest.approx(10 - 2.771)
    assert judgement.length_m == pytest.approx(10)


def test_an_unknown_demo_is_refused_with_what_there_is(mapstream: Terminal) -> None:
    done = mapstream("demo", "corridr")

    assert done.code == 2
    assert "no demo 'corridr'" in done.err
    assert "corridor" in done.err
