"""The graph of the page on cameras, on a short flight through W-VI."""

from __future__ import annotations

import re
from pathlib import Path

import anyio
import numpy as np
import pytest

from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.messages.vision import NFrame

_PAGE = Path(__file__).parents[2] / "docs" / "vision.md"


@pytest.fixture(scope="module")
def n_frames(tmp_path_factory: pytest.TempPathFactory) -> list[NFrame]:
    """Run the page's graph as it stands, but for the names of the topics; return what it recorded."""
    folder = tmp_path_factory.mktemp("vision")
    recording = simulate(
        "w_vi",
        folder / "flight.mcap",
        cameras=("front_left", "front_right"),
        camera={"width_px": 320, "height_px": 240},
        flight={"duration_s": 0.5, "start": "moving"},
        texel_m=0.02,
    )
    (graph,) = re.findall(r"```yaml\n(.*?)```", _PAGE.read_text(), re.DOTALL)
    graph = graph.replace("/cam0/", "/front_left/").replace("/cam1/", "/front_right/")
    (folder / "tracks.yaml").write_text(graph.replace("tracks.mcap", str(folder / "tracks.mcap")))

    run = plan(load_graph(folder / "tracks.yaml", params={"recording": str(recording)}))
    assert anyio.run(run_graph, run).exit_code == 0

    with open_recording(folder / "tracks.mcap") as written:
        decode = decoder_for(written.topics["/seen"].channel, NFrame)
        decoded = [decode(message) for message in written.messages(topics=["/seen"])]
    return [message for message in decoded if isinstance(message, NFrame)]


@pytest.mark.slow
def test_D9_kinds_run_side_by_side_from_recording_to_recording(n_frames: list[NFrame]) -> None:
    assert len(n_frames) == 11
    for frame in n_frames:
        kinds = [(f.frame, f.kind, f.descriptors.shape[1]) for f in frame.features]
        assert kinds == [
            ("front_left", "klt", 0),
            ("front_right", "klt", 0),
            ("front_left", "brisk", 64),
            ("front_right", "sift", 128),
        ]
        assert all(len(f) > 20 and f.camera is not None for f in frame.features)
        left, right = (set(np.array(f.track_ids)) for f in frame.features[:2])
        assert right <= left  # the same points
        assert not left & set(np.array(frame.features[3].track_ids))  # cameras count apart


@pytest.mark.slow
def test_D15_D19_each_kind_has_its_options_and_arrives_as_it_left(n_frames: list[NFrame]) -> None:
    for frame in n_frames:
        corners, _, brisk, sift = frame.features
        assert corners.sigmas_px is not None
        assert sift.sigmas_px is not None
        assert set(corners.sigmas_px) == {np.float32(0.8)}
        assert set(sift.sigmas_px) == {np.float32(1.6)}  # of images of half the size
        for features in (brisk, sift):
            for array in (features.scores, features.scales, features.orientations_rad):
                assert array is not None
                assert array.dtype == np.float32
                assert np.isfinite(array).all()
        assert sift.descriptors.dtype == np.float32
        assert brisk.descriptors.dtype == np.uint8
