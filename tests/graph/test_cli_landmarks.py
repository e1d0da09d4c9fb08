"""`mapstream map DIR VERB` on landmarks and keyframes, by both names of each verb."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mapstream.graph.cli.map.landmarks import VERBS, Verb
from mapstream.recordings.maps import load_map, save_map
from tests.graph.terminal import Terminal
from tests.operators.vision_worlds import World


@pytest.fixture
def world() -> World:
    return World(num_points=60, num_vertices=12, noise_px=0.2)


@pytest.fixture
def folder(tmp_path: Path, world: World) -> Path:
    path = tmp_path / "map"
    save_map(world.with_odometry(world.map(), 0.0005, 0.002), path)
    return path


def test_a_map_of_tracks_becomes_one_of_landmarks(mapstream: Terminal, folder: Path) -> None:
    """Created, judged, removed, optimised, keyframed and made sparse, by maplab's names."""
    steps: list[tuple[str, ...]] = [
        ("itl",), ("elq",), ("rbl",), ("optvi",), ("rtl",), ("rio",), ("rlq",), ("optv",),
        ("kfh", "--set", "every=3"), ("lsparsify", "--set", "num_landmarks=20"),
    ]  # fmt: skip

    outcomes = [mapstream("map", str(folder), *step, "--json") for step in steps]

    assert [(o.code, o.err) for o in outcomes] == [(0, "")] * len(steps)
    reports = [json.loads(o.out) for o in outcomes]
    assert reports[0]["num_found"] > 30
    assert set(reports[7]["kinds"]) == {"keypoints"}
    left = load_map(folder)
    assert len(left.landmarks) == 20
    assert len(left.vertices) < 12
    assert left.journal.operation.tolist()[-2:] == ["keyframe", "sparsify"]


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_every_verb_tells_what_it_did(mapstream: Terminal, folder: Path, verb: Verb) -> None:
    """On a map that has tracks only."""
    outcome = mapstream("map", str(folder), verb.name)

    assert outcome.code == 0, outcome.err
    assert verb.name in outcome.out
