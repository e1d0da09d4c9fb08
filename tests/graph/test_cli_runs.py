"""Verbs that read recordings, run graphs and write maps, on data of a few messages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.samples import samples
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.build import anchored, with_poses
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import read_tum, write_tum
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan, Message
from mapstream.streams.trajectory import Trajectory
from tests.graph.terminal import Terminal
from tests.recordings.made_maps import MISSION, OTHER_MISSION, line_map

GRAPH = """\
version: 1
name: poses
params: {out: {type: path, default: out.tum}}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {odometry: /odom}}}
  poses: {use: trajectory_sink, in: {odometry: sensors.odometry}, config: {path: $out}}
"""


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    file = tmp_path / "poses.yaml"
    file.write_text(GRAPH)
    return file


def record(file: Path, count: int = 20, **topics: type[Message]) -> Path:
    with McapWriter(file, chunk_bytes=1000) as writer:
        for topic, kind in topics.items():
            for message in samples(kind, count):
                writer.write(f"/{topic}", message)
    return file


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return record(tmp_path / "drive.mcap", odom=Odometry)


class TestRun:
    def test_R4_report_has_times_in_all_and_of_each_operator(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        done = mapstream("run", graph, drive, "--json")

        found = done.json
        assert (done.code, found["status"]) == (0, "complete")
        assert {"wall_s", "cpu_s", "speed", "limiting"} <= set(found)
        sensors, poses = found["operators"]
        assert {"num_calls", "p50_s", "p95_s", "busy_s", "cpu_s"} <= set(sensors)
        assert sensors["num_calls"] > 0
        assert poses["name"] == "poses"

    def test_tells_people_what_was_written(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        done = mapstream("run", graph, drive)

        assert "poses: complete in" in done.out
        assert "wrote out.tum" in done.out
        assert len(read_tum("out.tum")) == 20

    def test_section_of_a_recording(self, mapstream: Terminal, graph: Path, drive: Path) -> None:
        done = mapstream("run", graph, drive, "--start", "0.45", "--end", "1.05")

        assert done.code == 0
        assert len(read_tum("out.tum")) == 6

    def test_section_without_a_recording(self, mapstream: Terminal, graph: Path) -> None:
        assert mapstream("run", graph, "--start", "1").code == 2

    @pytest.mark.parametrize("rate", ["fast", "0", "-1", "nan"])
    def test_rate_that_is_none(
        self, mapstream: Terminal, graph: Path, drive: Path, rate: str
    ) -> None:
        done = mapstream("run", graph, drive, "--rate", rate)

        assert done.code == 2
        assert repr(rate) in done.err

    def test_rate_changes_nothing_but_the_time(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        for rate in ("max", "50"):
            mapstream("run", graph, drive, "--rate", rate, "--param", f"out={rate}.tum")

        assert Path("max.tum").read_bytes() == Path("50.tum").read_bytes()

    def test_B12_auto_rate_is_told_and_changes_no_result(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        mapstream("run", graph, drive)
        at_once = Path("out.tum").read_bytes()

        done = mapstream("run", graph, drive, "--rate", "auto")
        found = mapstream("run", graph, drive, "--rate", "auto", "--json").json

        assert "automatic rate" in done.out
        assert Path("out.tum").read_bytes() == at_once
        assert found["status"] == "complete"
        assert found["auto_rate"] > 1.0  # the rate climbs while the queues are empty

    def test_B12_a_profile_may_ask_for_auto_rate(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        graph.write_text(GRAPH + "profiles: {easy: {clock: {rate: auto}}}\n")

        found = mapstream("run", graph, drive, "--profile", "easy", "--json").json

        assert found["auto_rate"] > 1.0

    def test_B12_no_rate_for_a_run_by_the_wall_clock(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        done = mapstream("run", graph, drive, "--profile", "live", "--rate", "auto")

        assert done.code == 2
        assert "the profile 'live' runs by the wall clock" in done.err

    def test_P7_trace_of_a_run(self, mapstream: Terminal, graph: Path, drive: Path) -> None:
        done = mapstream("run", graph, drive, "--trace", "trace.jsonl")

        assert done.code == 0
        last = json.loads(Path("trace.jsonl").read_text().splitlines()[-1])
        assert [edge["sent"] for edge in last["edges"]] == [20]

    def test_recording_that_is_not_there(self, mapstream: Terminal, graph: Path) -> None:
        done = mapstream("run", graph, "nowhere.mcap")

        assert done.code == 1
        assert done.err.startswith("nowhere.mcap: no such file")

    def test_map_for_a_graph_that_makes_none(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        done = mapstream("run", graph, drive, "--map", "m")

        assert done.code == 2
        assert done.err.startswith("--map m: no parameter 'map'")

    def test_damaged_recording_ends_with_3_and_names_the_place(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        data = bytearray(drive.read_bytes())
        data[len(data) // 3] ^= 0xFF
        drive.write_bytes(data)

        done = mapstream("run", graph, drive)

        assert done.code == 3
        assert "finished with loss" in done.out
        assert "drive.mcap at byte" in done.err
        assert 0 < len(read_tum("out.tum")) < 20

    def test_failure_ends_with_1_and_the_operator(
        self, mapstream: Terminal, graph: Path, drive: Path
    ) -> None:
        done = mapstream("run", graph, drive, "--param", "out=poses.yaml/out.tum")

        assert done.code == 1
        assert "poses.yaml:6:3: operator 'poses' (trajectory_sink) failed" in done.err
        assert "Traceback" not in done.err

    def test_viewer_that_is_none(self, mapstream: Terminal, graph: Path, drive: Path) -> None:
        done = mapstream("run", graph, drive, "--rerun", "sve=x.rrd")

        assert done.code == 2
        assert "expected spawn, connect" in done.err

    def test_preset_reads_the_only_lidar_and_says_so(
        self, mapstream: Terminal, tmp_path: Path
    ) -> None:
        scans = record(tmp_path / "scans.mcap", 3, velodyne=LidarScan)

        done = mapstream("check", "lidar", scans)

        assert done.code == 0
        assert "reading /velodyne (mapstream.LidarScan); there is no /points" in done.err
        assert "/velodyne: 3 messages, 10 Hz, LidarScan" in done.out


@pytest.mark.slow
def test_preset_maps_a_recording(mapstream: Terminal, tmp_path: Path) -> None:
    """All of it once: scans to a map that keeps the rules, a trajectory, and a picture."""
    scans = record(tmp_path / "scans.mcap", 30, points=LidarScan)

    done = mapstream("run", "lidar", scans, "--map", "out", "--rerun", "save=out.rrd")

    assert done.code == 0, done.err
    assert mapstream("map", "out", "check").out == "out: no violations\n"
    assert len(read_tum("out.tum")) >= 2
    assert Path("out.rrd").stat().st_size > 10_000


class TestRecordings:
    def test_info(self, mapstream: Terminal, drive: Path) -> None:
        (topic,) = mapstream("info", drive, "--json").json["topics"]

        assert (topic["topic"], topic["count"], topic["read_as"]) == ("/odom", 20, "Odometry")

    def test_info_of_a_damaged_one(self, mapstream: Terminal, drive: Path) -> None:
        drive.write_bytes(drive.read_bytes()[:-200])

        done = mapstream("info", drive)

        assert done.code == 3
        assert "lost at byte" in done.err

    def test_doctor(self, mapstream: Terminal, drive: Path) -> None:
        done = mapstream("doctor", drive)

        assert (done.code, done.out.splitlines()[-1]) == (0, "nothing wrong")

    def test_doctor_of_a_damaged_one(self, mapstream: Terminal, drive: Path) -> None:
        data = bytearray(drive.read_bytes())
        data[len(data) // 3] ^= 0xFF
        drive.write_bytes(data)

        done = mapstream("doctor", drive)

        assert done.code == 3
        assert "lost at byte" in done.err

    def test_init_writes_a_graph_that_check_likes(
        self, mapstream: Terminal, tmp_path: Path
    ) -> None:
        scans = record(tmp_path / "scans.mcap", points=LidarScan, imu=ImuBatch)

        mapstream("init", scans, "--out", "mine.yaml")

        assert mapstream("check", "mine.yaml", scans).code == 0

    def test_init_keeps_a_file_that_is_there(
        self, mapstream: Terminal, tmp_path: Path, graph: Path
    ) -> None:
        scans = record(tmp_path / "scans.mcap", points=LidarScan)

        done = mapstream("init", scans, "--out", graph)

        assert done.code == 2
        assert graph.read_text() == GRAPH

    def test_convert(self, mapstream: Terminal, tmp_path: Path) -> None:
        write_tum(tmp_path / "poses.tum", line())

        done = mapstream("convert", f"tum:{tmp_path / 'poses.tum'}", "poses.mcap")

        assert done.code == 0
        assert "wrote poses.mcap: 30 messages" in done.out

    def test_convert_of_nothing_known(self, mapstream: Terminal) -> None:
        assert mapstream("convert", "kiti:x", "x.mcap").code == 2

    def test_simulate_says_which_worlds_and_options_there_are(self, mapstream: Terminal) -> None:
        assert "did you mean 'w_lid'" in mapstream("simulate", "w_lidd", "x.mcap").err
        done = mapstream("simulate", "w_lid", "x.mcap", "--set", "lidar.beems=3")
        assert done.code == 2
        assert "--set lidar.beems=3: lidar.beems: unknown key; did you mean 'beams'?" in done.err


def line(slope: float = 0.0, count: int = 30) -> Trajectory:
    """A drive round a bend, a metre each second, that climbs by `slope`."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angle = np.arange(count) / 20
    poses[:, 0, 3], poses[:, 1, 3] = 20 * np.sin(angle), 20 - 20 * np.cos(angle)
    poses[:, 2, 3] = slope * np.arange(count)
    return Trajectory(stamps_ns=np.arange(count) * 10**9, poses=poses)


class TestEval:
    def test_R1_of_a_known_error(self, mapstream: Terminal) -> None:
        """Without alignment, a climb of 0.1 m each pose is off by 0.1 m times its index."""
        write_tum("estimate.tum", line(0.1))
        write_tum("reference.tum", line())

        done = mapstream("eval", "estimate.tum", "reference.tum", "--align", "none", "--json")

        errors = done.json["errors"]["absolute, translation [m]"]
        assert errors["max"] == pytest.approx(2.9)
        assert errors["rmse"] == pytest.approx(np.sqrt(np.mean((0.1 * np.arange(30)) ** 2)))

    def test_prints_a_table(self, mapstream: Terminal) -> None:
        write_tum("estimate.tum", line(0.1))

        out = mapstream("eval", "estimate.tum", "estimate.tum").out

        assert "30 poses over 29.1 m, alignment se3" in out
        assert "not measured: the KITTI metric needs segments of 100 m" in out

    def test_trajectories_that_share_no_time(self, mapstream: Terminal, drive: Path) -> None:
        write_tum("estimate.tum", line())

        done = mapstream("eval", "estimate.tum", drive)

        assert done.code == 1
        assert "no stamps match" in done.err


class TestEvalOfRobots:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        """A map of two robots, of which the second lies 1 m off; their references are beside it."""
        both = merge_maps([turning_map(MISSION), turning_map(OTHER_MISSION)])
        for row, name in enumerate(("a.tum", "b.tum")):
            vertices = both.vertices_of(row)
            stamps_ns, poses = both.vertices.stamp_ns[vertices], both.T_map_base(vertices)
            write_tum(tmp_path / name, Trajectory(stamps_ns=stamps_ns, poses=poses))
        save_map(both, tmp_path / "truth")
        moved = anchored(both, 1, SE3.from_rotation(np.eye(3), [1.0, 0, 0]))
        save_map(moved, tmp_path / "m")
        return tmp_path / "m"

    def test_R3_one_alignment_for_all_and_one_for_each(
        self, mapstream: Terminal, folder: Path
    ) -> None:
        references = (f"{MISSION[:4]}=a.tum", f"{OTHER_MISSION[:4]}=b.tum")

        found = mapstream("eval", folder, *references, "--json").json

        assert found["translation"]["rmse"] == pytest.approx(0.5, abs=0.1)
        for robot in found["robots"].values():
            assert robot["own_translation"]["rmse"] < 1e-6
        by_map = mapstream("eval", folder, folder.parent / "truth", "--json").json
        assert by_map["translation"]["rmse"] == pytest.approx(found["translation"]["rmse"])
        assert "2 robots, 16 poses, one alignment se3" in mapstream("eval", folder, *references).out

    def test_several_references_without_missions(self, mapstream: Terminal, folder: Path) -> None:
        done = mapstream("eval", folder, "a.tum", "b.tum")

        assert done.code == 2
        assert "say which mission each is of, MISSION=PATH" in done.err


def turning_map(mission: str) -> Map:
    """A robot that does not go along a line."""
    map_ = line_map(8, mission)
    poses = se3_exp(np.random.default_rng(0).normal(size=(8, 6)))
    return with_poses(map_, np.arange(8), poses)


class TestMapFiles:
    @pytest.fixture
    def folder(self, mapstream: Terminal) -> str:
        write_tum("poses.tum", line())
        assert mapstream("map", "m", "import", "poses.tum").code == 0
        return "m"

    @pytest.mark.parametrize("suffix", ["tum", "g2o", "mcap", "kitti"])
    def test_S3_export(self, mapstream: Terminal, folder: str, suffix: str) -> None:
        done = mapstream("map", folder, "export", f"out.{suffix}")

        assert done.code == 0
        assert f"wrote out.{suffix}: 30 poses" in done.out

    def test_export_to_nothing_known(self, mapstream: Terminal, folder: str) -> None:
        done = mapstream("map", folder, "export", "out.doc")

        assert done.code == 1
        assert "unknown format '.doc'; known are .tum" in done.err

    def test_import_keeps_a_map_that_is_there(self, mapstream: Terminal, folder: str) -> None:
        done = mapstream("map", folder, "import", "poses.tum")

        assert done.code == 2
        assert "there is a map already" in done.err

    def test_optimize(self, mapstream: Terminal, folder: str) -> None:
        done = mapstream("map", folder, "optimize", "--json")

        assert done.code == 0
        assert done.json["num_edges"] == {"odometry": 29}
        assert mapstream("map", folder, "check").code == 0

    def test_option_of_the_optimizer_that_is_none(self, mapstream: Terminal, folder: str) -> None:
        done = mapstream("map", folder, "optimize", "--set", "solvr=lm")

        assert done.code == 2
        assert "--set solvr=lm: solvr: unknown key; did you mean 'solver'?" in done.err
