"""What was done to a map can be undone, and done again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.recordings.maps.build import add_resources, with_poses
from mapstream.recordings.maps.history import change_map, redo, undo
from mapstream.recordings.maps.manifest import read_manifest
from mapstream.recordings.maps.model import TABLES
from mapstream.streams.errors import MapCheckError, MapError, MapFormatError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import PointCloud
from tests.full_disk import largest_file
from tests.recordings.made_maps import files_under, full_map, line_map


def shift(folder: Path, metres: float) -> int:
    """Move the last vertex of the map in a folder."""

    def moved(map_: Map) -> tuple[Map, int]:
        last = len(map_.vertices) - 1
        pose = SE3.exp([0, 0, 0, metres, 0, 0]) @ map_.vertices.T_mission_base_of(last)
        return with_poses(map_, np.array([last]), pose.matrix), last

    return change_map(folder, "shift", moved, metres=metres)


def digest(folder: Path) -> str:
    return load_map(folder).digest()


def test_M19_undo_restores_the_digest_and_redo_the_change(tmp_path: Path) -> None:
    save_map(full_map(), tmp_path)
    digests = [digest(tmp_path)]
    for metres in (1.0, 2.0):
        assert shift(tmp_path, metres) == 5
        digests.append(digest(tmp_path))

    assert undo(tmp_path).digest() == digests[1] == digest(tmp_path)
    assert undo(tmp_path).digest() == digests[0] == digest(tmp_path)
    assert redo(tmp_path).digest() == digests[1]
    assert redo(tmp_path).digest() == digests[2] == digest(tmp_path)
    with pytest.raises(MapError, match="nothing to do again"):
        redo(tmp_path)


def test_M19_each_change_is_in_the_journal_with_its_parameters(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)

    shift(tmp_path, 0.5)
    shift(tmp_path, -2.0)

    journal = load_map(tmp_path).journal
    assert journal.operation.tolist() == ["shift", "shift"]
    assert [json.loads(text) for text in journal.parameters] == [{"metres": 0.5}, {"metres": -2.0}]


@settings(max_examples=8, deadline=None)
@given(st.lists(st.sampled_from(["shift", "undo", "redo"]), max_size=8))
def test_M19_any_order_of_changes_undos_and_redos_is_that_of_two_stacks(
    tmp_path_factory: pytest.TempPathFactory, steps: list[str]
) -> None:
    folder = tmp_path_factory.mktemp("map")
    save_map(line_map(3), folder)
    past, now, future = list[str](), digest(folder), list[str]()
    for number, step in enumerate(steps):
        if step == "shift":
            shift(folder, number + 1.0)
            past, now, future = [*past, now], digest(folder), []
        elif step == "undo" and past:
            past, now, future = past[:-1], past[-1], [*future, now]
            assert undo(folder).digest() == now
        elif step == "redo" and future:
            past, now, future = [*past, now], future[-1], future[:-1]
            assert redo(folder).digest() == now

        assert digest(folder) == now


def test_M19_only_the_newest_states_are_kept(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)
    for number in range(21):
        shift(tmp_path, number)

    manifest = read_manifest(tmp_path)
    assert len(manifest.past) == 20
    names = {f"tables/{path.name}" for path in (tmp_path / "tables").iterdir()}
    assert names == manifest.files()


def test_a_run_that_saves_begins_anew(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)
    shift(tmp_path, 1.0)
    save_map(line_map(4), tmp_path)

    with pytest.raises(MapError, match="nothing to undo; what runs and imports write stays"):
        undo(tmp_path)
    assert len(list((tmp_path / "tables").iterdir())) == len(TABLES)


def test_a_change_that_breaks_the_rules_is_not_saved(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)
    before = files_under(tmp_path)

    def broken(map_: Map) -> tuple[Map, None]:
        return replace(map_, edges=replace(map_.edges, switch=np.full(2, 2.0))), None

    with pytest.raises(MapCheckError, match="the switch is 2"):
        change_map(tmp_path, "break", broken)

    assert files_under(tmp_path) == before


def test_a_full_disk_leaves_the_map_and_its_history(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)
    shift(tmp_path, 1.0)
    before = files_under(tmp_path)

    with largest_file(20_000), pytest.raises(MapError, match="untouched"):
        change_map(tmp_path, "grow", lambda _: (line_map(200), None))

    assert files_under(tmp_path) == before
    undo(tmp_path)


def test_a_damaged_earlier_state_leaves_the_present_one(tmp_path: Path) -> None:
    save_map(line_map(3), tmp_path)
    shift(tmp_path, 1.0)
    now = digest(tmp_path)
    file = tmp_path / read_manifest(tmp_path).past[0]["vertices"].file
    file.write_bytes(file.read_bytes()[:-9])

    with pytest.raises(MapFormatError, match=f"{file.name}: damaged"):
        undo(tmp_path)
    file.unlink()
    with pytest.raises(MapFormatError, match=f"{file.name} is missing"):
        undo(tmp_path)

    assert digest(tmp_path) == now


def test_clouds_stay_while_a_state_names_them(tmp_path: Path) -> None:
    with CloudStore(tmp_path / "clouds") as store:
        store.put("c", PointCloud(stamp_ns=0, points=np.zeros((3, 3), dtype=np.float32)))
    file = tmp_path / "clouds" / "c.arrow"
    map_ = add_resources(
        line_map(3), vertex_rows=np.array([0]), kind="cloud", paths=["clouds/c.arrow"]
    )
    save_map(map_, tmp_path)

    def without_clouds(map_: Map) -> tuple[Map, None]:
        return map_.select(resources=map_.resources.kind != "cloud"), None

    change_map(tmp_path, "drop", without_clouds)
    assert file.exists()
    undo(tmp_path)
    change_map(tmp_path, "drop", without_clouds)
    for _ in range(20):
        shift(tmp_path, 0.1)

    assert not file.exists()


def test_a_folder_without_a_map_is_not_made(tmp_path: Path) -> None:
    for step in (lambda: shift(tmp_path / "no", 1.0), lambda: undo(tmp_path / "no")):
        with pytest.raises(MapFormatError, match="not a map folder"):
            step()

    assert not (tmp_path / "no").exists()
