"""Each verb says what it did, gives JSON to programs, and an exit code to both."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mapstream.graph.cli import VERBS
from mapstream.operators.samples import samples
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.messages.estimates import Submap
from tests.graph.terminal import Terminal

GRAPH = """\
version: 1
name: odometry
params: {voxel_size_m: {type: float, default: 1.0}}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {scans: /points}}}
  odometry: {use: kiss_odometry, in: {scans: sensors.scans}, config: {voxel_size_m: $voxel_size_m}}
"""


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    file = tmp_path / "odometry.yaml"
    file.write_text(GRAPH)
    return file


class TestAsAWhole:
    def test_help_lists_every_verb(self, mapstream: Terminal) -> None:
        done = mapstream("--help")

        assert done.code == 0
        assert all(f"  {verb} " in done.out for verb in VERBS)

    @pytest.mark.parametrize("verb", VERBS)
    def test_every_verb_has_help(self, mapstream: Terminal, verb: str) -> None:
        done = mapstream(verb, "--help")

        assert done.code == 0
        assert f"mapstream {verb}" in done.out

    def test_wrong_verb(self, mapstream: Terminal) -> None:
        done = mapstream("grph")

        assert done.code == 2
        assert "Did you mean 'graph'" in done.err

    def test_wrong_option(self, mapstream: Terminal) -> None:
        assert mapstream("check", "lidar", "--nonsense").code == 2

    def test_help_imports_nothing_heavy(self) -> None:
        code = (
            "import sys\n"
            "from mapstream.graph.cli import command_line\n"
            "command_line(['--help'])\n"
            "heavy = {'numpy', 'pydantic', 'scipy', 'cv2', 'rerun', 'gtsam', 'pyarrow', 'anyio'}\n"
            "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False
        )

        assert (done.returncode, done.stderr) == (0, "")


class TestCheck:
    def test_B17_graph_without_mistakes(self, mapstream: Terminal, graph: Path) -> None:
        done = mapstream("check", graph)

        assert done.code == 0
        assert "odometry: 2 operators, 1 edges, no problems" in done.out

    def test_B17_mistake_with_file_and_line(self, mapstream: Terminal, graph: Path) -> None:
        graph.write_text(GRAPH.replace("kiss_odometry", "kis_odometry"))

        done = mapstream("check", graph)

        assert done.code == 2
        assert "odometry.yaml:6:14: operators.odometry.use: no operator 'kis_odometry'" in done.err
        assert "Traceback" not in done.err

    def test_as_json(self, mapstream: Terminal, graph: Path) -> None:
        graph.write_text(GRAPH.replace("scans: sensors.scans", "scan: sensors.scans"))

        done = mapstream("check", graph, "--json")

        assert done.code == 2
        assert [problem["line"] for problem in done.json["problems"]] == [6, 6]

    def test_option_that_is_wrong(self, mapstream: Terminal, graph: Path) -> None:
        done = mapstream("check", graph, "--set", "odometry.voxel_size_m=-1")

        assert done.code == 2
        assert done.err.startswith(
            "--set odometry.voxel_size_m=-1: operators.odometry.config.voxel"
        )

    def test_parameter_that_is_not_written_as_one(self, mapstream: Terminal, graph: Path) -> None:
        assert mapstream("check", graph, "--param", "voxel").code == 2

    @pytest.mark.parametrize("preset", ["lidar", "lidar_gicp", "semantic", "semantic_recorded"])
    def test_presets_have_no_mistakes(self, mapstream: Terminal, preset: str) -> None:
        assert mapstream("check", preset).code == 0

    def test_graph_that_is_not_there(self, mapstream: Terminal) -> None:
        done = mapstream("check", "lidr")

        assert done.code == 2
        assert done.err == "no graph file and no preset 'lidr'; did you mean 'lidar'?\n"


class TestGraph:
    def test_B17_drawn_as_mermaid(self, mapstream: Terminal, graph: Path) -> None:
        assert mapstream("graph", graph, "--mermaid").out.startswith("flowchart LR\n")

    def test_drawn_as_text(self, mapstream: Terminal, graph: Path) -> None:
        assert "odometry  (kiss_odometry, process)" in mapstream("graph", graph).out

    def test_as_json(self, mapstream: Terminal, graph: Path) -> None:
        (edge,) = mapstream("graph", graph, "--json").json["edges"]

        assert (edge["from"], edge["to"], edge["type"]) == (
            "sensors.scans",
            "odometry.scans",
            "LidarScan",
        )


class TestOperators:
    def test_lists_all(self, mapstream: Terminal) -> None:
        names = [row["name"] for row in mapstream("operators", "--json").json]

        assert {"mcap", "kiss_odometry", "optimizer", "map_store"} <= set(names)

    def test_tells_one_in_full(self, mapstream: Terminal) -> None:
        out = mapstream("operators", "kiss_odometry").out

        assert "scans  LidarScan" in out
        assert "voxel_size_m" in out

    def test_unknown_one(self, mapstream: Terminal) -> None:
        done = mapstream("operators", "kis_odometry")

        assert (done.code, done.err) == (
            2,
            "no operator 'kis_odometry'; did you mean 'kiss_odometry'?\n",
        )


class TestSchema:
    def test_is_json_with_every_operator(self, mapstream: Terminal) -> None:
        schema = mapstream("schema").json

        assert "kiss_odometry" in schema["$defs"]["OperatorSpec"]["properties"]["use"]["enum"]


class TestMap:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        save_map(append_submap(Map.empty(), samples(Submap, 1)[0]), tmp_path / "map")
        return tmp_path / "map"

    def test_check_of_a_good_map(self, mapstream: Terminal, folder: Path) -> None:
        done = mapstream("map", folder, "check")

        assert (done.code, done.out) == (0, "map: no violations\n")

    def test_check_of_a_bad_map(self, mapstream: Terminal, folder: Path) -> None:
        (table,) = (folder / "tables").glob("edges-*")
        table.write_bytes(table.read_bytes()[:-9])

        done = mapstream("map", folder, "check")

        assert done.code == 1
        assert "damaged" in done.err

    def test_stats(self, mapstream: Terminal, folder: Path) -> None:
        found = mapstream("map", folder, "stats", "--json").json

        assert found["num_rows"]["vertices"] == 2
        assert [(edge["kind"], edge["count"]) for edge in found["edges"]] == [("odometry", 1)]

    def test_info_of_a_map(self, mapstream: Terminal, folder: Path) -> None:
        assert "1 missions" in mapstream("info", folder).out

    def test_no_map(self, mapstream: Terminal) -> None:
        done = mapstream("map", "nowhere", "check")

        assert done.code == 1
        assert "nowhere: not a map folder" in done.err
