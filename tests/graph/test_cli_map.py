"""`mapstream map DIR VERB`: every verb that changes a map is in its journal, and can be undone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.maps import check_map, load_map, save_map
from mapstream.recordings.maps.build import add_edges
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from tests.graph.terminal import Terminal
from tests.recordings.made_maps import MISSION, OTHER_MISSION, STEP_NS, full_map, line_map

LOOPS = """mission_a,stamp_a_ns,mission_b,stamp_b_ns,x,y,z,qx,qy,qz,qw,rotation_sigma_rad,translation_sigma_m
0f0f,1000,0f0f,1000001000,2,0,0,0,0,0,1,0.1,1
"""
LOOP = RelativePose(
    kind="loop",
    mission_a=MISSION,
    stamp_a_ns=1_000,
    mission_b=MISSION,
    stamp_b_ns=1_000 + 5 * STEP_NS,
    T_a_b=SE3.identity(),  # false: the robot went on by 5 m
    covariance=np.eye(6) * 1e-6,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_map(line_map(6), tmp_path / "m")
    (tmp_path / "loops.csv").write_text(LOOPS)
    return tmp_path / "m"


CHANGES = {  # command -> a part of what it says
    "optimize": "",
    "relax --mission 0f --loops loops.csv": "",
    "relax --each": "",
    "reject-outliers": "0 of 0 absolute measurements",
    "reject-outliers --loops --set gate_probability=0.99": "0 of 0 loops",
    "align": "0 missions placed",
    "close-loops --from loops.csv": "1 of 1 loops added",
    "loops delete": "0 edges",
    "fix-stationary --set max_distance_m=2": "5 of 5 stretches",
    "anchor 0f --unknown": "only a guess",
    "anchor line --at 1,2,3": "known",
    "edit uncertainty --kind odometry --set factor=2": "5 edges",
    "edit switch --edge 1 --set value=0": "1 edges",
    "edit disturb --set seed=3": "6 vertices",
    "remove line --start-ns 1000 --end-ns 500001000": "2 vertices removed",
    "merge other": "2 missions, 10 vertices",
    "region add dock --polygon 1,0.5": "place 'dock'",
}


@pytest.mark.parametrize("command", CHANGES)
def test_M19_a_change_is_in_the_journal_and_undo_takes_it_back(
    mapstream: Terminal, folder: Path, command: str
) -> None:
    before = load_map(folder).digest()
    if command == "merge other":
        save_map(line_map(4, OTHER_MISSION), folder.parent / "other")

    done = mapstream("map", folder, *command.split())

    assert done.code == 0, done.err
    assert CHANGES[command] in done.out
    changed = load_map(folder)
    assert check_map(changed, folder) == []
    assert changed.journal.operation[-1] in command
    assert mapstream("map", folder, "undo").out.startswith(
        f"m: undid {changed.journal.operation[-1]}"
    )
    assert load_map(folder).digest() == before
    assert mapstream("map", folder, "redo").code == 0
    assert load_map(folder).digest() == changed.digest()


def test_M19_the_journal_is_listed(mapstream: Terminal, folder: Path) -> None:
    mapstream("map", folder, "anchor", "0f", "--unknown")
    mapstream("map", folder, "edit", "disturb", "--set", "seed=3")
    mapstream("map", folder, "undo")

    found = mapstream("map", folder, "journal", "--json").json
    listed = mapstream("map", folder, "journal").out

    assert (found["undo"], found["redo"]) == (1, 1)
    [entry] = found["journal"]
    assert entry == {"operation": "anchor", "parameters": {"is_known": False, "mission": "0f"}}
    assert "1 steps to undo, 1 to redo" in listed


def test_nothing_to_undo(mapstream: Terminal, folder: Path) -> None:
    done = mapstream("map", folder, "undo")

    assert (done.code, done.err.split(";")[0]) == (1, f"{folder}: there is nothing to undo")


def test_U13_a_solution_that_ruins_the_map_is_not_kept(mapstream: Terminal, folder: Path) -> None:
    save_map(add_edges(line_map(6), [LOOP]), folder)
    before = load_map(folder).digest()

    done = mapstream("map", folder, "optimize")

    assert done.code == 1
    assert "the map got worse and stays as it was" in done.err
    assert load_map(folder).digest() == before
    assert mapstream("map", folder, "optimize", "--keep").code == 0
    assert mapstream("map", folder, "undo").code == 0
    assert load_map(folder).digest() == before


def test_loops_that_lead_nowhere_are_said(mapstream: Terminal, folder: Path) -> None:
    Path("loops.csv").write_text(LOOPS.replace("1000001000", "9"))

    done = mapstream("map", folder, "close-loops", "--from", "loops.csv")

    assert "m: 0 of 1 loops added" in done.out
    assert "left out: 1 loops: 9 ns lies outside mission" in done.err


def test_options_that_say_nothing_are_refused(mapstream: Terminal, folder: Path) -> None:
    for words in (
        ("edit", "switch", "--edge", "1"),
        ("anchor", "0f", "--at", "1,2"),
        ("anchor", "0f", "--at", "1,2,3", "--unknown"),
    ):
        assert mapstream("map", folder, *words).code == 2


def test_M4_files_come_along_and_clashes_are_named(mapstream: Terminal, folder: Path) -> None:
    save_map(full_map(), folder.parent / "other")

    done = mapstream("map", folder, "merge", "other")

    assert done.code == 1
    assert f"mission {MISSION} is in two maps, and its " in done.err


def test_K10_covariances_of_poses_are_told(mapstream: Terminal, folder: Path) -> None:
    """Odometry of six vertices: five steps of 0.1 m each."""
    told = mapstream("map", folder, "covariance", "--json").json

    [pose] = told["poses"]
    sigma_m = np.sqrt(np.trace(np.array(pose["covariance"])[3:, 3:]) / 3)
    assert sigma_m == pytest.approx(np.sqrt(5) * 0.1, rel=0.05)
    out = mapstream("map", folder, "covariance", "--mission", "line", "--stamp-ns", "1000").out
    assert "0f0f0f0f" in out
