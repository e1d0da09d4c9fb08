"""`mapstream map DIR label`, `where` and `region`: what people call things and places."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mapstream.recordings.maps import check_map, load_map, save_map
from tests.graph.terminal import Terminal
from tests.operators.maps.test_naming import furnished

KITCHEN = ("region", "add", "kitchen", "--polygon", "0,0.5 4,0.5 4,2 0,2")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_map(furnished(), tmp_path / "m")
    return tmp_path / "m"


def test_N9_label_then_where(mapstream: Terminal, folder: Path) -> None:
    """By class and place, by place alone, and by id; the answer is the pose, for people and as JSON."""
    assert mapstream("map", folder, *KITCHEN).out == "m: room 'kitchen', 6.0 m^2\n"
    labelled = mapstream("map", folder, "label", "1.4,1.2,0.75", "kitchen table")
    mapstream("map", folder, "label", "cup", "my cup", "--near", "1,1,0.8")

    found = mapstream("map", folder, "where", "kitchen table", "--json")
    told = mapstream("map", folder, "where", "cup", "--near", "0,0,0")

    assert labelled.out.endswith("is now called 'kitchen table'\n")
    (table,) = json.loads(found.out)
    assert table["position"] == pytest.approx([1.0, 1.0, 0.7])
    assert table["regions"] == ["kitchen"]
    assert "my cup" in told.out.splitlines()[1]
    assert "0.10 x 0.10 x 0.12" in told.out
    assert mapstream("map", folder, "label", table["id"][:8], "desk").code == 0
    assert "was 'desk'" in mapstream("map", folder, "unlabel", "desk").out
    nothing = mapstream("map", folder, "where", "desk").out
    assert nothing == "m: nothing is called 'desk'; there are cup, cupboard, plane\n"
    assert check_map(load_map(folder), folder) == []
    assert load_map(folder).journal.operation.tolist()[-1] == "unlabel"


def test_N10_regions_are_added_listed_asked_and_removed(mapstream: Terminal, folder: Path) -> None:
    mapstream("map", folder, *KITCHEN, "--z", "0", "--height-m", "2.5")
    mapstream("map", folder, "region", "add", "charger", "--polygon=-1,0.5")

    listed = json.loads(mapstream("map", folder, "region", "list", "--json").out)
    inside = mapstream("map", folder, "region", "at", "1,1,1").out
    outside = mapstream("map", folder, "region", "at", "-1,1,1").out
    robot = json.loads(mapstream("map", folder, "region", "at", "--json").out)

    assert [(r["name"], r["kind"], r["num_vertices"]) for r in listed] == [
        ("charger", "place", 0), ("kitchen", "room", 0),
    ]  # fmt: skip
    assert inside == "the point: kitchen\n"
    assert outside == "the point: in no region\n"
    assert list(robot.values()) == [[]]
    assert mapstream("map", folder, "region", "remove", "charger").code == 0
    assert "kitchen" in mapstream("map", folder, "region", "list").out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("region", "add", "x", "--polygon", "0,0 1,1"), "two corners"),
        (("region", "add", "x", "--polygon", "0,0,1 1,1"), 'expected "x,y x,y x,y"'),
        (("region", "remove", "x"), "no region 'x'"),
        (("label", "cup", "x"), "2 landmarks are called 'cup'"),
        (("label", "cup", " "), "an empty name"),
        (("where", "cup", "--near", "1,2"), "expected x,y,z"),
    ],
)
def test_what_cannot_be_named_is_refused(
    mapstream: Terminal, folder: Path, arguments: tuple[str, ...], message: str
) -> None:
    refused = mapstream("map", folder, *arguments)

    assert refused.code != 0
    assert message in refused.err
