"""Verbs on what things are called: names by hand, and where what is called so is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapstream.graph.cli.map.choosing import point_of
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json, say_table
from mapstream.operators.maps.naming import Naming, find_landmark, known_words, name_landmark
from mapstream.operators.maps.where import Thing
from mapstream.operators.maps.where import where as where_is
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.history import change_map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError

LandmarkArgument = Annotated[
    str,
    typer.Argument(
        metavar="LANDMARK",
        help="First digits of its id, its class or name; or x,y,z, for the nearest object or plane.",
    ),
]
NearOption = Annotated[str | None, typer.Option(help="x,y,z: the one that is nearest to it.")]
WithinOption = Annotated[float, typer.Option(help="So far it may be from there [m].")]


def label(
    context: typer.Context,
    landmark: LandmarkArgument,
    name: Annotated[str, typer.Argument(help="What people call it: kitchen table.")],
    *,
    near: NearOption = None,
    within_m: WithinOption = 1.0,
    json: JsonFlag = False,
) -> None:
    """Give a landmark or a plane a name: `label table "kitchen table"`, `label 1.2,0,0.7 "desk"`."""
    if not name.strip():
        raise ConfigError("an empty name is none: `unlabel` takes a name away")
    _rename(
        context.obj, "label", landmark, name=name.strip(), near=near, within_m=within_m, json=json
    )


def unlabel(
    context: typer.Context,
    landmark: LandmarkArgument,
    *,
    near: NearOption = None,
    within_m: WithinOption = 1.0,
    json: JsonFlag = False,
) -> None:
    """Take the name of a landmark away."""
    _rename(context.obj, "unlabel", landmark, name="", near=near, within_m=within_m, json=json)


def _rename(  # noqa: PLR0913  # one for each option of the command
    folder: Path,
    operation: str,
    landmark: str,
    *,
    name: str,
    near: str | None,
    within_m: float,
    json: bool,
) -> None:
    text, place = _meant(landmark, near)

    def renamed(map_: Map) -> tuple[Map, Naming]:
        return name_landmark(map_, find_landmark(map_, text, place, within_m), name)

    found = change_map(folder, operation, renamed, landmark=landmark, name=name or None, near=near)
    if json:
        say_json(found)
        return
    thing = f"{found.label or found.kind} {found.landmark[:8]}"
    before = f", which was {found.was!r}" if found.was else ""
    now = f"is now called {name!r}" if name else "has no name any more"
    say(f"{in_place(folder)}: {thing}{before}, {now}")


def where(
    context: typer.Context,
    what: Annotated[
        str, typer.Argument(help="A name, class, text or kind, in any case; * for any letters.")
    ],
    *,
    near: Annotated[str | None, typer.Option(help="x,y,z: the nearest to it first.")] = None,
    json: JsonFlag = False,
) -> None:
    """Tell where what is called so is: objects, planes and regions, in the map frame."""
    folder: Path = context.obj
    map_ = load_map(folder)
    found = where_is(map_, what, None if near is None else point_of(near))
    if json:
        say_json(found)
        return
    if not found:
        say(f"{in_place(folder)}: nothing is called {what!r}; there are {known_words(map_)}")
        return
    columns = ["id", "class", "name", "x m", "y m", "z m", "size m", "in", "seen"]
    say_table(
        [*columns, *(["away m"] if near else [])],
        [[*_row(thing), *([thing.distance_m] if near else [])] for thing in found],
    )


def _row(thing: Thing) -> Sequence[object]:
    called = thing.name or thing.text
    return (
        thing.id[:8] or "-",
        thing.label or thing.kind,
        called or "-",
        *(float(value) for value in thing.position),
        "-" if thing.extent_m is None else _size(thing.extent_m),
        ", ".join(thing.regions) or "-",
        thing.num_observations,
    )


def _size(extent_m: FloatArray) -> str:
    return " x ".join(f"{side:.2f}" for side in extent_m if np.isfinite(side))


def _meant(landmark: str, near: str | None) -> tuple[str, FloatArray | None]:
    """Return by what a landmark is called and near what it is; `1,2,3` alone is a place."""
    if landmark.count(",") == 2 and near is None:
        return "", point_of(landmark)
    return landmark, None if near is None else point_of(near)
