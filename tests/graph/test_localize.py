"""`mapstream localize`: what it says before it begins."""

from pathlib import Path

from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.mcap_writer import McapWriter
from tests.graph.terminal import Terminal
from tests.operators.places import made_maps, scenes


def _recording(path: Path) -> Path:
    with McapWriter(path):
        pass
    return path


def test_a_recording_without_images_is_refused(mapstream: Terminal, tmp_path: Path) -> None:
    place = made_maps.room(0, 200)
    rig = {"camera": scenes.camera()}
    save_map(
        made_maps.flown(Map.empty(), place, "a" * 32, made_maps.circle(4), rig), tmp_path / "m"
    )

    said = mapstream("localize", "m", str(_recording(tmp_path / "r.mcap")))

    assert said.code == 2
    assert "no topic with images" in said.err


def test_a_map_of_features_that_are_not_detected_is_refused(
    mapstream: Terminal, tmp_path: Path
) -> None:
    save_map(Map.empty(), tmp_path / "m")

    said = mapstream("localize", "m", str(_recording(tmp_path / "r.mcap")))

    assert said.code == 2
    assert "its landmarks are of the kinds none" in said.err
