"""Verbs on rooms and places."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydantic import ValidationError

from mapstream.graph.cli.map.choosing import MissionOption, point_of
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json, say_table
from mapstream.operators.maps.missions import find_mission
from mapstream.operators.maps.regions import (
    Region,
    RegionConfig,
    add_region,
    regions_at,
    regions_of,
    remove_region,
)
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.history import change_map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError

region = typer.Typer(
    help="Rooms and places with names.", no_args_is_help=True, rich_markup_mode=None
)
NameArgument = Annotated[str, typer.Argument(help="What people call it.")]


@region.command("add")
def add(  # noqa: PLR0913  # one for each option of the command
    context: typer.Context,
    name: NameArgument,
    *,
    polygon: Annotated[
        str, typer.Option(help='Corners in the map frame: "x,y x,y x,y"; a single one is a place.')
    ],
    z: Annotated[float | None, typer.Option(help="Height of the outline [m].")] = None,
    height_m: Annotated[
        float | None,
        typer.Option(help="How far it reaches up; without, it has no floor or ceiling."),
    ] = None,
    kind: Annotated[str, typer.Option(help="room, corridor, place ...")] = "",
    json: JsonFlag = False,
) -> None:
    """Give a room or a place a name; it moves with the map."""
    folder: Path = context.obj
    corners = tuple(_corner(text) for text in polygon.split())
    kind = kind or ("room" if len(corners) > 1 else "place")
    try:
        config = RegionConfig(name=name, kind=kind, polygon=corners, z_m=z, height_m=height_m)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"region {name!r}: {first['loc'][0]}: {first['msg']}") from error
    added = change_map(
        folder,
        "region add",
        lambda map_: add_region(map_, config),
        **config.model_dump(mode="json", exclude_none=True),
    )
    if json:
        say_json(_plain(added))
        return
    size = f", {added.area_m2:.1f} m^2" if len(added.corners) > 1 else ""
    say(f"{in_place(folder)}: {kind} {name!r}{size}")


@region.command("remove")
def remove(
    context: typer.Context,
    name: NameArgument,
    *,
    kind: Annotated[str | None, typer.Option(help="Only of this kind.")] = None,
    json: JsonFlag = False,
) -> None:
    """Take a region out."""
    folder: Path = context.obj
    num = change_map(
        folder, "region remove", lambda map_: remove_region(map_, name, kind), name=name, kind=kind
    )
    if json:
        say_json({"path": folder, "num_removed": num})
    else:
        say(f"{in_place(folder)}: {num} regions removed")


@region.command("list")
def list_(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Tell which regions there are, where, and how many vertices lie in them."""
    folder: Path = context.obj
    map_ = load_map(folder)
    regions = regions_of(map_)
    positions = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
    counts = [sum(each.holds(p) for p in positions) for each in regions]
    if json:
        say_json(
            [
                {**_plain(each), "num_vertices": count}
                for each, count in zip(regions, counts, strict=True)
            ]
        )
        return
    say(f"{in_place(folder)}: {len(regions)} regions")
    if regions:
        say_table(
            ("region", "kind", "x m", "y m", "z m", "area m^2", "height m", "vertices"),
            [
                (r.name, r.kind, *map(float, r.center), r.area_m2, r.height_m, count)
                for r, count in zip(regions, counts, strict=True)
            ],
        )


@region.command("at", context_settings={"ignore_unknown_options": True})  # -1,0,0 is none
def at(
    context: typer.Context,
    place: Annotated[
        str | None, typer.Argument(metavar="X,Y,Z", help="Without: where the robots were last.")
    ] = None,
    *,
    mission: MissionOption = None,
    stamp_ns: Annotated[int | None, typer.Option(help="Where the robots were then.")] = None,
    json: JsonFlag = False,
) -> None:
    """Tell in which regions a point is, or the robots, the smallest first."""
    map_ = load_map(context.obj)
    regions = regions_of(map_)
    points = _robots(map_, mission, stamp_ns) if place is None else {"the point": point_of(place)}
    found = {who: [r.name for r in regions_at(regions, p)] for who, p in points.items()}
    if json:
        say_json(found)
        return
    for who, names in found.items():
        say(f"{who}: {', '.join(names) or 'in no region'}")


def _robots(map_: Map, mission: str | None, stamp_ns: int | None) -> dict[str, FloatArray]:
    """Return where each robot was (3,) at a stamp, or last, by mission."""
    rows = range(len(map_.missions)) if mission is None else [find_mission(map_, mission)]
    found = {}
    for row in rows:
        vertices = map_.vertices_of(row)
        stamps_ns = map_.vertices.stamp_ns[vertices]
        if not len(vertices):
            continue
        nearest = -1 if stamp_ns is None else int(np.abs(stamps_ns - stamp_ns).argmin())
        name = map_.missions.name[row] or map_.mission_id(row)[:8]
        found[f"{name} at {stamps_ns[nearest]} ns"] = map_.T_map_base(vertices[[nearest]])[0, :3, 3]
    return found


def _corner(text: str) -> tuple[float, float]:
    try:
        x, y = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f'--polygon: expected "x,y x,y x,y", found {text!r}') from None
    return x, y


def _plain(found: Region) -> dict[str, object]:
    return {
        "name": found.name,
        "kind": found.kind,
        "corners": found.corners,
        "height_m": found.height_m,
        "area_m2": found.area_m2,
    }
