"""Verbs on the clouds of keyframes: registered to each other, and places that are recognised by them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, fraction_bar, in_place, say, say_json
from mapstream.operators.lidar.constraints.register import RegisterConfig, RegisterReport
from mapstream.operators.lidar.constraints.register import register as register_tool
from mapstream.operators.lidar.places.find_places import FindPlacesConfig, FindPlacesReport
from mapstream.operators.lidar.places.find_places import find_places as find_places_tool
from mapstream.recordings.maps.history import change_map


def register(
    context: typer.Context,
    *,
    again: Annotated[
        bool, typer.Option("--again", help="Also what is registered already: poses are better now.")
    ] = False,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Register keyframes that lie near each other by their clouds: loop edges that may be switched off. Also: admc."""
    folder: Path = context.obj
    sets = [*(set_ or ()), *(["again=true"] if again else [])]
    config = config_from(RegisterConfig, sets)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    with fraction_bar("registering") as show:
        report = change_map(
            folder, "register", lambda map_: register_tool(map_, config, folder, show), **settings
        )
    _tell(folder, "register", report, json=json)


def find_places(context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False) -> None:
    """Find places that a LiDAR saw again, without a guess, and anchor missions that were lost by them."""
    folder: Path = context.obj
    config = config_from(FindPlacesConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    with fraction_bar("finding places") as show:
        report = change_map(
            folder,
            "find-places",
            lambda map_: find_places_tool(map_, config, folder, show),
            **settings,
        )
    _tell(folder, "find-places", report, json=json)


def _tell(
    folder: Path, verb: str, report: RegisterReport | FindPlacesReport, *, json: bool
) -> None:
    if json:
        say_json(report)
        return
    say(f"{in_place(folder)}: {verb}")
    for line in report.lines():
        say(line)
