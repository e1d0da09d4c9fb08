"""What was done to a map, and how to take it back."""

from __future__ import annotations

import json as json_
from pathlib import Path

import typer

from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json, say_table
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.history import redo as redo_change
from mapstream.recordings.maps.history import undo as undo_change
from mapstream.recordings.maps.manifest import read_manifest


def journal(context: typer.Context, *, json: JsonFlag = False) -> None:
    """List what was done to the map, in order, with the options."""
    folder: Path = context.obj
    done = load_map(folder, tables=["journal"]).journal
    manifest = read_manifest(folder)
    steps = {"undo": len(manifest.past), "redo": len(manifest.future)}
    if json:
        entries = [
            {"operation": operation, "parameters": json_.loads(parameters)}
            for operation, parameters in zip(done.operation, done.parameters, strict=True)
        ]
        say_json({"path": folder, "journal": entries, **steps})
        return
    rows = list(enumerate(zip(done.operation, done.parameters, strict=True), start=1))
    say_table(("step", "operation", "with"), [(number, *entry) for number, entry in rows])
    say(f"{steps['undo']} steps to undo, {steps['redo']} to redo")


def undo(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Bring back the map as it was before the last change."""
    folder: Path = context.obj
    before = load_map(folder, tables=["journal"])
    _tell(folder, "undid", before, undo_change(folder), json=json)


def redo(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Do again what was undone last."""
    folder: Path = context.obj
    map_ = redo_change(folder)
    _tell(folder, "did again", map_, map_, json=json)


def _tell(folder: Path, what: str, named_by: Map, now: Map, *, json: bool) -> None:
    last = named_by.journal
    operation = f"{last.operation[-1]} {last.parameters[-1]}" if len(last) else "the last change"
    digest = now.digest()
    if json:
        say_json({"path": folder, "operation": operation, "digest": digest})
    else:
        say(f"{in_place(folder)}: {what} {operation}, digest {digest[:16]}")
