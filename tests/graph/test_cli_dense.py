"""`mapstream map DIR VERB` for dense maps, by maplab's names where there are any."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.dense.distance_field import load_field
from mapstream.operators.dense.volume_files import load_volume
from mapstream.recordings.maps import load_map, save_map
from mapstream.recordings.mesh_files import read_mesh
from tests.graph.terminal import Terminal
from tests.operators.dense.recorded_room import true_map, write_recording

COARSE = ("--voxel-size-m", "0.2")


@pytest.mark.slow
def test_O3_O5_O7_O8_a_recorded_room_becomes_dense(mapstream: Terminal, tmp_path: Path) -> None:
    """Volume, mesh, field with a slice, clouds; each verb tells what it wrote, and the map can undo."""
    write_recording(tmp_path / "room.mcap", rate_hz=1.0)
    folder = tmp_path / "map"
    save_map(true_map(tmp_path / "room.mcap"), folder)
    slice_ = ("--picture", str(tmp_path / "slice.png"), "--at-z-m", "1.0")
    steps: list[tuple[str, ...]] = [
        ("tsdf", str(tmp_path / "room.npz"), *COARSE),
        ("export_tsdf", str(tmp_path / "room.ply"), *COARSE, "--set", "min_part_faces=10"),
        ("esdf", str(tmp_path / "field.npz"), *COARSE, *slice_),
        ("convert_all_depth_maps_to_point_clouds", "--json"),
        ("undo",),
    ]

    outcomes = [mapstream("map", str(folder), *step) for step in steps]

    assert [(o.code, o.err) for o in outcomes] == [(0, "")] * len(steps)
    assert "fused 5 depth images" in outcomes[0].out
    assert len(load_volume(tmp_path / "room.npz")) > 20
    assert len(read_mesh(tmp_path / "room.ply").faces) > 200
    assert np.isfinite(load_field(tmp_path / "field.npz").distance_m).all()
    assert (tmp_path / "slice.png").exists()
    assert json.loads(outcomes[3].out)["num_clouds"] == 5
    assert set(load_map(folder).resources.kind) == {"record"}


def test_a_map_without_anything_to_fuse_says_what_is_missing(
    mapstream: Terminal, tmp_path: Path
) -> None:
    write_recording(tmp_path / "room.mcap", rate_hz=1.0)
    map_ = true_map(tmp_path / "room.mcap")
    save_map(map_.select(resources=map_.resources.topic == "/color/image"), tmp_path / "map")

    outcome = mapstream("map", str(tmp_path / "map"), "mesh", str(tmp_path / "a.ply"))
    sdr = mapstream("map", str(tmp_path / "map"), "sdr")

    assert outcome.code == 1
    assert "neither depth images nor clouds" in outcome.err
    assert sdr.code == 1
    assert "no vertex refers to images of two cameras" in sdr.err
