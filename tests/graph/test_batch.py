"""`mapstream batch FILE`: the same as the commands typed one by one, and a failure stops it."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapstream.recordings.maps import load_map, save_map
from tests.graph.terminal import Terminal
from tests.recordings.made_maps import OTHER_MISSION, line_map

BATCH = """version: 1
maps: {morning: a, evening: b}
commands:
  - $morning merge $evening
  - $morning edit disturb --set translation_sigma_m=0.1 --set seed=3
  - $morning optimize
  - $morning export all.g2o
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    save_map(line_map(6), tmp_path / "a")
    save_map(line_map(4, OTHER_MISSION), tmp_path / "b")
    return tmp_path


def test_M2_M3_a_batch_does_what_its_commands_do(mapstream: Terminal, folder: Path) -> None:
    (folder / "work.yaml").write_text(BATCH)
    save_map(line_map(6), folder / "typed")

    done = mapstream("batch", "work.yaml")
    for command in BATCH.splitlines()[3:]:
        words = command.removeprefix("  - $morning").replace("$evening", "b").replace("all", "one")
        assert mapstream("map", "typed", *words.split()).code == 0

    assert done.code == 0
    assert load_map(folder / "a").digest() == load_map(folder / "typed").digest()
    assert (folder / "all.g2o").read_bytes() == (folder / "one.g2o").read_bytes()


def test_M2_the_first_failure_stops_it_with_line_and_code(
    mapstream: Terminal, folder: Path
) -> None:
    (folder / "work.yaml").write_text(
        "version: 1\nmaps: {m: a}\ncommands:\n- $m optimize\n- $m merge nowhere\n- $m undo\n"
    )

    ended = mapstream("batch", "work.yaml")

    assert ended.code == 1
    assert "work.yaml:5" in ended.err
    assert "nowhere" in ended.err
    operations = load_map(folder / "a").journal.operation.tolist()
    assert operations[-1] == "optimize"  # done, and not undone


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("maps: {}\n", "expected a batch file"),
        ("version: 1\ncommand: []\n", "did you mean 'commands'"),
        ("version: 1\ncommands: []\n", "expected a list of commands"),
        ("version: 1\nmaps: {evening: b}\ncommands: [$evning check]\n", "did you mean 'evening'"),
        ("version: 1\ncommands: ['a edit \"x']\n", "cannot be split into words"),
    ],
)
def test_M2_a_mistake_is_named_before_anything_runs(
    mapstream: Terminal, folder: Path, text: str, reason: str
) -> None:
    (folder / "work.yaml").write_text(text)

    ended = mapstream("batch", "work.yaml")

    assert ended.code == 2
    assert "work.yaml:" in ended.err
    assert reason in ended.err


def test_M2_a_dry_run_prints_what_would_be_done(mapstream: Terminal, folder: Path) -> None:
    (folder / "work.yaml").write_text(BATCH)

    ended = mapstream("batch", "work.yaml", "--dry-run")

    assert ended.out.splitlines()[0] == "$ mapstream map a merge b"
    assert len(load_map(folder / "a").missions) == 1
