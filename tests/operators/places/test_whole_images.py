"""Places that are proposed because their images are alike as a whole."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.networks.onnx_graph import Graph
from mapstream.operators.places.loops import VisualLoopsConfig, find_visual_loops
from mapstream.operators.places.searching import SearchConfig, search
from mapstream.operators.places.whole_images import (
    WholeImages,
    WholeImagesConfig,
    whole_images,
)
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import MapError
from mapstream.streams.messages.sensors import EncodedImage, RecordRef
from tests.operators.places import made_maps, scenes
from tests.recordings.made_maps import submaps

LAP = made_maps.LAP


@pytest.fixture(scope="module")
def two_laps() -> Map:
    truth = made_maps.circle(LAP + 6)
    front = {"camera": scenes.camera()}
    return made_maps.flown(Map.empty(), made_maps.room(), "a" * 32, truth, front)


def _looks(angles: np.ndarray) -> WholeImages:
    """Vectors that are the more alike, the nearer two angles are."""
    vectors = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    return WholeImages(vertex=np.arange(len(angles)), vectors=vectors)


def _config(candidates: str, **options: object) -> VisualLoopsConfig:
    return VisualLoopsConfig.model_validate({"candidates": candidates, **options})


@pytest.mark.slow
def test_H17_places_that_are_alike_as_a_whole_become_loops(two_laps: Map) -> None:
    alike = _looks(2 * np.pi * np.arange(LAP + 6) / LAP)

    _, by_votes = find_visual_loops(two_laps)
    _, by_images = find_visual_loops(two_laps, _config("global"), alike)

    assert by_images.num_accepted >= 0.9 * by_votes.num_accepted >= 5


def test_H17_geometry_refuses_what_is_only_alike_as_a_whole(two_laps: Map) -> None:
    """The images of the other side of the room look most alike."""
    false = np.where(np.arange(LAP + 6) < LAP, np.pi, 0.0)
    alike = _looks(2 * np.pi * np.arange(LAP + 6) / LAP + false)
    one = {"whole_images": {"num_vertices": 1}}

    _, alone = find_visual_loops(two_laps, _config("global", **one), alike)
    _, both = find_visual_loops(two_laps, _config("both", **one), alike)
    _, by_votes = find_visual_loops(two_laps)

    assert alone.num_accepted < by_votes.num_accepted
    assert both.num_accepted >= by_votes.num_accepted


def test_H17_proposals_are_looked_at_where_votes_recognise_nothing(two_laps: Map) -> None:
    asked: list[int] = []

    def propose(vertex: int, among: Collection[int]) -> list[int]:
        assert max(among) <= vertex - 10  # the gap of ten seconds
        asked.append(vertex)
        return sorted(among)[:5]

    voted = [*search(two_laps, SearchConfig())]
    both = [*search(two_laps, SearchConfig(), propose)]

    assert asked == [each.vertex for each in voted if each.recognition.found is None]
    assert 0 < len(asked) < len(voted)
    for a, b in zip(voted, both, strict=True):
        of_votes = a.recognition.candidates
        assert b.recognition.candidates[: len(of_votes)] == of_votes


def test_the_most_alike_come_first_and_of_those_asked_for() -> None:
    images = WholeImages(
        vertex=np.array([0, 0, 1, 2, 3]),
        vectors=np.array([[0, 1], [1, 0], [0.8, 0.6], [1, 0], [0, 1]], np.float32),
    )

    assert images.most_alike(2, {0, 1}, 5) == [0, 1]
    assert images.most_alike(3, {0, 1, 2}, 2) == [0, 1]
    assert images.most_alike(2, (), 5) == []
    assert images.most_alike(9, {0, 1}, 5) == []


def _mean_color(folder: Path) -> Path:
    graph = Graph("mean_color")
    image = graph.input("image", np.float32, [1, 3, "height", "width"])
    mean = graph.add("ReduceMean", image, axes=[2, 3], keepdims=0)
    graph.output("embedding", mean, np.float32, [1, 3])
    file = folder / "mean_color.onnx"
    file.write_bytes(graph.serialize())
    return file


def test_images_are_read_from_the_recordings_behind_a_map(tmp_path: Path) -> None:
    [submap] = submaps([2])
    recording = tmp_path / "drive.mcap"
    keyframes = []
    with McapWriter(recording) as writer:
        for number, keyframe in enumerate(submap.keyframes):
            stamp_ns = keyframe.stamp_ns
            pixels = np.zeros((64, 64, 3), np.uint8)
            pixels[1:, :, number] = 200  # blue, green, red
            png = np.frombuffer(cv2.imencode(".png", pixels)[1].tobytes(), np.uint8)
            image = EncodedImage(stamp_ns=stamp_ns, data=png, format="png", frame="cam0")
            writer.write("/cam0/image", image, stamp_ns)
            record = RecordRef(path=str(recording), topic="/cam0/image", log_ns=stamp_ns)
            keyframes.append(replace(keyframe, records=(record,)))
    map_ = append_submap(Map.empty(), replace(submap, keyframes=tuple(keyframes)))

    images = whole_images(map_, WholeImagesConfig(model=_mean_color(tmp_path)))

    assert images.vertex.tolist() == [0, 1, 2]
    np.testing.assert_allclose(images.vectors, np.eye(3)[::-1], atol=1e-6)  # red first


def test_a_map_without_images_says_so(two_laps: Map, tmp_path: Path) -> None:
    config = _config("global", whole_images={"model": str(_mean_color(tmp_path))})

    with pytest.raises(MapError, match="no images of 8 bits"):
        find_visual_loops(two_laps, config)
