"""`mapstream map DIR register` and `find-places`: what they change, and what they say."""

import json
from pathlib import Path

from mapstream.operators.lidar.constraints.register import SOURCE
from mapstream.recordings.maps import load_map, save_map
from tests.graph.terminal import Terminal
from tests.operators.lidar.drives import circle, stored, submap_of


def test_L1_register_changes_the_map_by_both_its_names(mapstream: Terminal, tmp_path: Path) -> None:
    save_map(stored(submap_of(circle(5)), tmp_path / "m"), tmp_path / "m")

    said = mapstream("map", "m", "register", "--set", "neighbours=0")
    again = mapstream("map", "m", "admc", "--again", "--set", "neighbours=0", "--json")

    assert said.code == again.code == 0
    assert "5 of 5 pairs registered: 4 consecutive, 1 within" in said.out
    report = json.loads(again.out)
    assert report["num_removed"] == report["num_added"] == 5
    assert {pair["verdict"] for pair in report["pairs"]} == {"accepted"}
    map_ = load_map(tmp_path / "m")
    assert (map_.edges.source == SOURCE).sum() == 5
    assert map_.journal.operation.tolist()[-2:] == ["register", "register"]


def test_L1_find_places_tells_what_was_compared(mapstream: Terminal, tmp_path: Path) -> None:
    save_map(stored(submap_of(circle(3)), tmp_path / "m"), tmp_path / "m")

    said = mapstream("map", "m", "find-places")

    assert said.code == 0
    assert "keyframes compared" in said.out
    assert "0 loops within missions, 0 between them" in said.out
