"""A graph runs on a data set as it was downloaded: converted once, into the cache."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from tests.graph.terminal import Terminal
from tests.recordings import made_datasets

_GRAPH = """version: 1
name: looking
params:
  recording: {{type: path}}
  map: {{type: path, default: unused}}
operators:
  sensors: {{use: mcap, config: {{path: $recording, topics: {{images: {images}, odometry: /truth}}}}}}
  decode: {{use: image_decode, in: {{images: sensors.images}}}}
  out:
    use: mcap_sink
    in: {{frames: decode.frames, odometry: sensors.odometry}}
    config: {{path: {out}, schemas: mapstream, topics: {{frames: /frames, odometry: /truth}}}}
"""


def written(path: Path, topic: str) -> list[Any]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "mapstream"


_SETS: dict[str, tuple[Callable[[Path], Path], str, int]] = {  # images of one camera, and how many
    "euroc": (made_datasets.euroc, "/cam1/image", 1),
    "kitti": (made_datasets.kitti, "/cam1/image", 2),
    "tum": (made_datasets.tum, "/color/image", 1),
    "7scenes": (made_datasets.seven_scenes, "/color/image", 2),
}


@pytest.mark.parametrize("kind", list(_SETS))
def test_A24_a_graph_runs_on_a_data_set(
    kind: str, mapstream: Terminal, cache: Path, tmp_path: Path
) -> None:
    make, topic, num_frames = _SETS[kind]
    source = make(tmp_path / "set")
    graph, out = tmp_path / "graph.yaml", tmp_path / "out.mcap"
    graph.write_text(_GRAPH.format(images=topic, out=out))

    done = mapstream("run", graph, "--dataset", f"{kind}:{source}")

    assert done.code == 0, done.err
    frames = written(out, "/frames")
    assert len(frames) == num_frames
    assert all(frame.camera is not None for frame in frames)
    assert written(out, "/truth")
    (made,) = cache.iterdir()
    time_ns = made.stat().st_mtime_ns
    assert mapstream("run", graph, "--dataset", f"{kind}:{source}").code == 0
    assert made.stat().st_mtime_ns == time_ns, "the second run reads what the first one made"


def test_a_data_set_that_changed_is_converted_anew(
    mapstream: Terminal, cache: Path, tmp_path: Path
) -> None:
    source = made_datasets.kitti(tmp_path / "set")
    graph, out = tmp_path / "graph.yaml", tmp_path / "out.mcap"
    graph.write_text(_GRAPH.format(images="/cam0/image", out=out))
    mapstream("run", graph, "--dataset", f"kitti:{source}")

    for name in ("image_0", "image_1"):
        (source / name / "000001.png").unlink()
    mapstream("run", graph, "--dataset", f"kitti:{source}")

    assert len(written(out, "/frames")) == 1
    assert len(list(cache.iterdir())) == 2


def test_a_data_set_takes_the_place_of_the_recording(mapstream: Terminal, tmp_path: Path) -> None:
    both = mapstream("run", "lidar", tmp_path / "a.mcap", "--dataset", "kitti:b")
    neither = mapstream("run", "lidar", "--dataset", f"kitti:{tmp_path / 'b'}")

    assert both.code == neither.code == 2
    assert "takes the place of the recording" in both.err
    assert "there is nothing at" in neither.err
