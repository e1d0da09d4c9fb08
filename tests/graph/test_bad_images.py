"""What is wrong with images is named and counted, and the run goes on with the others."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.messages.sensors import EncodedImage
from tests.graph.terminal import Terminal
from tests.operators.images.cameras import camera

_GRAPH = """version: 1
name: images
params: {{recording: {{type: path}}, map: {{type: path, default: unused}}}}
operators:
  sensors: {{use: mcap, config: {{path: $recording, topics: {{images: /cam/image}}}}}}
  decode: {{use: image_decode, in: {{images: sensors.images}}}}
  straight: {{use: undistort, in: {{frames: decode.frames}}}}
  out:
    use: mcap_sink
    in: {{frames: straight.frames}}
    config: {{path: {out}, schemas: mapstream, topics: {{frames: /frames}}}}
"""


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    path = tmp_path / "graph.yaml"
    path.write_text(_GRAPH.format(out=tmp_path / "out.mcap"))
    return path


def _recorded(path: Path, *, is_calibrated: bool) -> Path:
    """Write six images: two good ones, a damaged, an empty, a small and a black one."""
    light = np.full((120, 160), 90, np.uint8)
    pictures = [light, light, light, light, light[::2, ::2], light * 0]
    with McapWriter(path) as writer:
        if is_calibrated:
            writer.write("/cam/camera_info", camera("radtan", stamp_ns=1))
        for index, picture in enumerate(pictures):
            data = np.asarray(cv2.imencode(".png", picture)[1])
            data = {2: data[:40], 3: data[:0]}.get(index, data)
            image = EncodedImage(stamp_ns=10 + index, data=data, format="png", frame="cam")
            writer.write("/cam/image", image)
    return path


def test_bad_images_are_counted_by_name_and_the_others_arrive(
    graph: Path, mapstream: Terminal, tmp_path: Path
) -> None:
    done = mapstream("run", graph, _recorded(tmp_path / "drive.mcap", is_calibrated=True), "--json")

    assert done.code == 3
    said = done.out + done.err
    for text in (
        "images of cam that cannot be decoded (png)",
        "images of cam with 80 x 60 px, where the calibration is of 160 x 120 px",
        "images of cam that are black",
    ):
        assert text in said
    with open_recording(tmp_path / "out.mcap") as recording:
        decode = decoder_for(recording.topics["/frames"].channel)
        stamps = [decode(raw).stamp_ns for raw in recording.messages(["/frames"])]
    assert stamps == [10, 11, 15]


def test_a_camera_without_calibration_is_named_with_what_to_do(
    graph: Path, mapstream: Terminal, tmp_path: Path
) -> None:
    done = mapstream("run", graph, _recorded(tmp_path / "drive.mcap", is_calibrated=False))

    assert done.code == 1
    assert "straight" in done.out + done.err
    assert "the camera cam has no calibration" in done.out + done.err
    assert "give the source of the recording a `rig`" in done.out + done.err
