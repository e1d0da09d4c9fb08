"""What a run leaves in the map's folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.operator import Context
from mapstream.operators.sinks.map_store import MapStore, MapStoreConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps import Map, check_map, load_map
from mapstream.recordings.maps.folder import LOCK, FolderLock
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import Submap
from tests.recordings.made_maps import (
    MISSION,
    OTHER_MISSION,
    files_under,
    submaps,
)

pytestmark = pytest.mark.anyio


def growing(parts: list[Submap]) -> list[Map]:
    maps = [Map.empty()]
    for part in parts:
        maps.append(append_submap(maps[-1], part))
    return maps[1:]


async def store(
    folder: Path, parts: list[Submap], *, on_existing: str = "error", with_clouds: bool = True
) -> Context:
    config = MapStoreConfig.model_validate({"path": folder, "on_existing": on_existing})
    ran = Context(name="store")
    clouds = parts if with_clouds else []
    await run_operator(MapStore(config), run_context=ran, maps=growing(parts), submaps=clouds)
    return ran


async def test_the_last_map_is_saved_with_all_clouds(tmp_path: Path) -> None:
    parts = submaps([3, 6, 8], with_clouds=True)

    await store(tmp_path / "map", parts)

    map_ = load_map(tmp_path / "map")
    assert check_map(map_, tmp_path / "map") == []
    rows = np.flatnonzero(map_.resources.kind == "cloud")
    np.testing.assert_array_equal(map_.resources.vertex[rows], np.arange(9))
    third = parts[1].keyframes[1]
    assert third.cloud is not None
    found = read_cloud(tmp_path / "map" / map_.resources.path[rows[4]])
    np.testing.assert_array_equal(found.points, third.cloud.points)
    assert found.stamp_ns == map_.vertices.stamp_ns[4] == third.stamp_ns


async def test_two_runs_leave_the_same_bytes(tmp_path: Path) -> None:
    parts = submaps([3, 6, 8], with_clouds=True)

    await store(tmp_path / "a", parts)
    await store(tmp_path / "b", parts)

    first, second = files_under(tmp_path / "a"), files_under(tmp_path / "b")
    del first[LOCK], second[LOCK]
    assert first == second


async def test_a_map_without_clouds_is_saved_too(tmp_path: Path) -> None:
    parts = submaps([3])

    await store(tmp_path, parts, with_clouds=False)

    assert load_map(tmp_path).digest() == growing(parts)[-1].digest()


async def test_a_run_without_maps_says_so(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=f"no map came, so none was saved in {tmp_path}"):
        await store(tmp_path, [])

    assert not (tmp_path / "manifest.json").exists()


async def test_an_existing_map_is_not_touched_by_default(tmp_path: Path) -> None:
    await store(tmp_path, submaps([3], with_clouds=True))
    before = files_under(tmp_path)

    with pytest.raises(
        MapError, match=f"{tmp_path}: there is a map already.*--set store.on_existing=replace"
    ):
        await store(tmp_path, submaps([5], OTHER_MISSION))

    assert files_under(tmp_path) == before


async def test_a_replaced_map_leaves_no_clouds(tmp_path: Path) -> None:
    await store(tmp_path, submaps([3], with_clouds=True))

    await store(tmp_path, submaps([2], OTHER_MISSION, with_clouds=True), on_existing="replace")

    assert len(list((tmp_path / "clouds").iterdir())) == 3
    assert check_map(load_map(tmp_path), tmp_path) == []


async def test_a_new_mission_is_merged_with_the_map_that_is_there(tmp_path: Path) -> None:
    await store(tmp_path, submaps([3], with_clouds=True))

    await store(tmp_path, submaps([2], OTHER_MISSION, with_clouds=True), on_existing="merge")

    map_ = load_map(tmp_path)
    assert [map_.mission_id(row) for row in range(2)] == [MISSION, OTHER_MISSION]
    assert check_map(map_, tmp_path) == []
    assert len(list((tmp_path / "clouds").iterdir())) == 7


async def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")

    with pytest.raises(MapError, match=r"neither a map nor empty, it has thesis\.tex"):
        await store(tmp_path, submaps([2]), on_existing="replace")


async def test_a_second_run_into_the_folder_is_refused(tmp_path: Path) -> None:
    with FolderLock(tmp_path), pytest.raises(MapError, match="another run writes"):
        await store(tmp_path, submaps([2]))


async def test_a_failed_run_leaves_the_map_that_was_there(tmp_path: Path) -> None:
    await store(tmp_path, submaps([4], with_clouds=True))
    before = files_under(tmp_path)
    parts = submaps([3], with_clouds=True)

    with pytest.raises(ExceptionGroup) as caught:
        await store(tmp_path, parts, on_existing="merge")

    assert caught.group_contains(MapError, match=f"mission {MISSION} already.*to replace")
    assert files_under(tmp_path) == before
