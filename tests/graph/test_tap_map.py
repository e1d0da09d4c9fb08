"""A stored map is drawn with its clouds."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapstream.graph.tap_map import view_map
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.operators.sinks.map_store import MapStore, MapStoreConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import load_map
from mapstream.streams.errors import MapError
from tests.graph import made_messages as made
from tests.graph.rrd import read_rrd, strict, unused_url, values_of

pytestmark = pytest.mark.anyio


async def test_P1_a_stored_map_is_drawn_with_its_cloud(tmp_path: Path) -> None:
    folder, file = tmp_path / "map", tmp_path / "map.rrd"
    store = MapStore(MapStoreConfig(path=folder))
    await run_operator(store, maps=[made.made_map()], submaps=[made.submap()])

    with strict():
        notes = view_map(load_map(folder), folder, SinkSpec.parse(f"save={file}").open())

    assert notes == []
    entities = read_rrd(file)
    assert len(values_of(entities["/map/cloud"], "Points3D:positions")[0]) > 50
    assert len(values_of(entities["/map/edges/loop"], "LineStrips3D:strips")[0]) == 1
    assert f"/map/trajectory/{made.MISSION[:8]}" in entities


def test_a_map_without_clouds_is_drawn_and_says_so(tmp_path: Path) -> None:
    file = tmp_path / "map.rrd"

    notes = view_map(made.made_map(), tmp_path, SinkSpec.parse(f"save={file}").open())

    assert len(notes) == 1
    assert "without clouds" in notes[0]
    assert f"/map/trajectory/{made.MISSION[:8]}" in read_rrd(file)


def test_no_viewer_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(MapError, match="start one with"):
        view_map(made.made_map(), None, SinkSpec.parse(f"connect={unused_url()}").open())
