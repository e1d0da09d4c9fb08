"""Three AprilTags on the walls of a hall keep a drifting robot where it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.cli.evaluate import compare
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.maps import check_map, load_map
from mapstream.recordings.recording import open_recording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import TransformBatch
from tests.graph.terminal import Terminal

_CAMERAS = ("front_left", "left", "rear")
_READER = """
  decode_{0}: {{use: image_decode, in: {{images: sensors.images_{0}}}}}
  tags_{0}:
    use: fiducials
    in: {{frames: decode_{0}.frames}}
    config: {{size_m: 0.5, tags_file: $tags, frame: hall}}"""
_GRAPH = """version: 1
name: tags
params:
  recording: {type: path}
  map: {type: path}
  tags: {type: str, default: ""}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {odometry: /odometry, %(topics)s}}}%(readers)s
  trajectory:
    use: trajectory
    in: {odometry: sensors.odometry, %(inputs)s}
    config: {sources: {odometry: {kind: odometry}}, constraints: {%(constraints)s}}
  optimizer: {use: optimizer, in: {submaps: trajectory.submaps}}
  store: {use: map_store, in: {maps: optimizer.maps, submaps: trajectory.submaps}, config: {path: $map}}
"""


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fly once round an eight of 32 m, past three tags of half a metre."""
    return simulate(
        "w_vi",
        tmp_path_factory.mktemp("hall") / "hall.mcap",
        seed=3,
        cameras=_CAMERAS,
        tags=3,
        texel_m=0.01,
        camera={"rate_hz": 1.0},
        flight={"duration_s": 30.0},
    )


def _graph(path: Path) -> Path:
    graph = _GRAPH % {
        "topics": ", ".join(f"images_{name}: /{name}/image" for name in _CAMERAS),
        "readers": "".join(_READER.format(name) for name in _CAMERAS),
        "inputs": ", ".join(f"{name}: tags_{name}.constraints" for name in _CAMERAS),
        "constraints": ", ".join(f"{name}: {{}}" for name in _CAMERAS),
    }
    path.write_text(graph)
    return path


def _places(recording: Path, path: Path) -> Path:
    """Write where the tags are, as the recording knows it."""
    with open_recording(recording) as opened:
        decode = decoder_for(opened.topics["/truth/tags"].channel)
        (truth,) = (decode(raw) for raw in opened.messages(["/truth/tags"]))
    assert isinstance(truth, TransformBatch)
    lines = ["tags:"]
    for name, T in zip(truth.children, truth.T_parent_child, strict=True):
        place = SE3(T)
        numbers = [*place.t.tolist(), *place.quat_xyzw.tolist()]
        lines.append(f"  - {{id: {name.split(':')[1]}, T_frame_tag: {numbers}}}")
    path.write_text("\n".join(lines))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("is_known", [True, False])
def test_A13_three_tags_keep_the_map_of_W_VI_within_3_cm(
    is_known: bool,  # noqa: FBT001
    hall: Path,
    mapstream: Terminal,
    tmp_path: Path,
) -> None:
    tags = _places(hall, tmp_path / "tags.yaml") if is_known else ""

    graph, folder = _graph(tmp_path / "graph.yaml"), tmp_path / "map"
    done = mapstream("run", graph, hall, "--map", folder, "--param", f"tags={tags}")

    assert done.code == 0, done.err
    map_ = load_map(folder)
    assert check_map(map_, folder) == []
    kind = "absolute" if is_known else "landmark"
    assert np.count_nonzero(map_.edges.kind == kind) > 15
    score = compare(read_trajectory(folder), read_trajectory(hall), "se3")
    assert score.errors["absolute, translation [m]"].rmse < 0.03
    if not is_known:
        assert sorted(map_.landmarks.kind) == ["pose"] * 3
