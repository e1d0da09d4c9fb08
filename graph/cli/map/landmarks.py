"""Verbs on landmarks, keyframes and cameras: each is a map tool, with maplab's name for it as a second one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, plain, say, say_json
from mapstream.operators.maps.steps import loaded
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.history import change_map


@dataclass(frozen=True, slots=True)
class Verb:
    """One map tool as a verb; the tool has the name with underscores."""

    name: str
    alias: str  # maplab's
    help: str

    @property
    def tool(self) -> str:
        return self.name.replace("-", "_")


VERBS = (
    Verb("create-landmarks", "itl", "Make landmarks of tracks that have none yet."),
    Verb("object-landmarks", "", "Make one landmark of each object that detectors found, with its class and extent."),
    Verb("retriangulate", "rtl", "Put landmarks where their observations see them from the poses of now."),
    Verb("evaluate-quality", "elq", "Judge which landmarks are good and which are bad."),
    Verb("reset-quality", "rlq", "Forget which landmarks are good."),
    Verb("remove-bad-landmarks", "rbl", "Take bad landmarks out; their keypoints stay."),
    Verb("remove-invalid-observations", "rio", "Free landmarks of observations that cannot be true."),
    Verb("keyframe", "kfh", "Keep vertices that say something new, and merge the edges between."),
    Verb("sparsify", "lsparsify", "Keep the landmarks that are most useful for localisation."),
    Verb("close-semantic-loops", "", "Find places whose objects were seen again: edges, and landmarks merged if wanted."),
    Verb("close-visual-loops", "lc", "Find places that cameras saw again: edges, or landmarks merged."),
    Verb("anchor-missions", "aam", "Find where missions lie by what they see of anchored ones."),
    Verb("calibrate", "", "Find places, lenses or clocks of cameras, and tell how sure that is."),
    Verb("compress-descriptors", "", "Keep fewer numbers of each descriptor of a kind, by principal components."),
    Verb("train-projection", "train_projection_matrix", "Learn how an index projects descriptors of a kind."),
    Verb("represent-objects", "", "Choose the few descriptors that stand for all of an object."),
)  # fmt: skip


def add_verbs(app: typer.Typer) -> None:
    """Add the verbs, and their second names, which help does not list."""
    for verb in VERBS:
        known = f"{verb.help} Also: {verb.alias}." if verb.alias else verb.help
        app.command(verb.name, help=known)(_command(verb))
        if verb.alias:
            app.command(verb.alias, help=known, hidden=True)(_command(verb))


def optimize_visual(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Bundle adjustment by images alone: poses, landmarks, and fixed vertices."""
    sets = ['kinds=["keypoints","points","fixed"]', *(set_ or [])]
    _run(context.obj, Verb("optimize", "optv", ""), sets, json=json)


def _command(verb: Verb) -> Callable[..., None]:
    def command(context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False) -> None:
        _run(context.obj, verb, set_, json=json)

    return command


def _run(folder: Path, verb: Verb, sets: list[str] | None, *, json: bool) -> None:
    tool, config_type = loaded(verb.tool)
    config = config_from(config_type or OperatorConfig, sets)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    options = {} if config_type is None else {"config": config}
    report = change_map(folder, verb.name, lambda map_: tool(map_, **options), **settings)
    if json:
        say_json(report if not isinstance(report, int) else {"path": folder, "num": report})
        return
    say(f"{in_place(folder)}: {verb.name}")
    for line in _lines(report):
        say(line)


def _lines(report: Any) -> Iterator[str]:  # noqa: ANN401  # each tool has its own
    """Return what to tell people: the report's own lines, or its numbers by name."""
    if hasattr(report, "lines"):
        yield from report.lines()
        return
    if isinstance(report, int):
        yield f"{report} landmarks"
        return
    for name, value in plain(report).items():
        if isinstance(value, dict):
            value = ", ".join(f"{count} {what}" for what, count in value.items()) or "none"  # noqa: PLW2901
        yield f"{name.removeprefix('num_').replace('_', ' ')}: {value}"
