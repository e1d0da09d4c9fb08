"""`mapstream compare`: several graphs or choices on one recording, as a table."""

import json
from pathlib import Path

import pytest

from mapstream.graph.cli.compare import variants
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.errors import ConfigError
from tests.graph.terminal import Terminal


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compare") / "drive.mcap"
    lidar = {"beams": 2, "columns": 8}
    return simulate("w_lid", path, seed=1, length_m=36.0, speed_mps=12.0, lidar=lidar)


def test_every_combination_is_a_variant() -> None:
    made = list(
        variants(["lidar", "my/graph.yaml"], ["loops.registration=icp,gicp", "voxel_m=1,2"])
    )

    assert len(made) == 8
    assert made[1].name == "lidar registration=icp voxel_m=2"
    assert made[4].name == "graph registration=icp voxel_m=1"
    assert made[0].choices == (("loops.registration", "icp"), ("voxel_m", "1"))


def test_a_comma_in_brackets_does_not_end_a_value() -> None:
    made = list(variants(["lidar"], ["loops.links=[1, 2],[]"]))

    assert [dict(each.choices) for each in made] == [
        {"loops.links": "[1, 2]"},
        {"loops.links": "[]"},
    ]
    with pytest.raises(ConfigError, match=r"--vary links: expected OPERATOR\.KEY=A,B"):
        list(variants(["lidar"], ["links"]))


@pytest.mark.slow
def test_choices_are_run_and_compared_with_the_truth(mapstream: Terminal, drive: Path) -> None:
    """A parameter of the graph has two values; both maps are judged and kept."""
    said = mapstream(
        *("compare", "odometry", str(drive), "--vary", "distance_m=0.5,3.0"),
        *("--keep", "kept", "--align", "none", "--json"),
    )

    assert said.code == 0
    found = json.loads(said.out)["variants"]
    assert [each["choices"] for each in found] == [{"distance_m": "0.5"}, {"distance_m": "3.0"}]
    for each in found:
        assert each["status"] == "complete"
        assert each["seconds"] > 0
        assert 0 < each["score"]["errors"]["absolute, translation [m]"]["rmse"] < 1.0
    assert found[0]["score"]["num_pairs"] > 2 * found[1]["score"]["num_pairs"]


def test_a_recording_and_a_graph_are_needed(mapstream: Terminal) -> None:
    said = mapstream("compare", "lidar")

    assert said.code == 2
    assert "expected graphs and, last, a recording" in said.err
