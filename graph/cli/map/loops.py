"""Verbs on loop closures: from a file, deleted, and of robots that stood still."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.map.choosing import MissionOption
from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, complain, in_place, say, say_json
from mapstream.operators.maps import loops as tools
from mapstream.operators.maps.missions import find_mission
from mapstream.operators.maps.stationary import StationaryConfig
from mapstream.operators.maps.stationary import fix_stationary as fix_stationary_tool
from mapstream.recordings.loop_files import read_loops
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.history import change_map

loops = typer.Typer(help="Loop closures of the map.", no_args_is_help=True, rich_markup_mode=None)


def close_loops(
    context: typer.Context,
    *,
    file: Annotated[Path, typer.Option("--from", help="YAML or CSV, see docs/map-tools.md.")],
    json: JsonFlag = False,
) -> None:
    """Add loop closures from a file, between the vertices nearest to their stamps."""
    folder: Path = context.obj
    found = read_loops(file)
    report = change_map(
        folder, "close-loops", lambda map_: tools.close_loops(map_, found), file=file.name
    )
    if json:
        say_json(report)
        return
    say(f"{in_place(folder)}: {report.num_added} of {len(found)} loops added")
    for reason, count in report.left_out.items():
        complain(f"left out: {count} loops: {reason}")


@loops.command("delete")
def delete(
    context: typer.Context,
    *,
    kind: Annotated[list[str] | None, typer.Option(help="Of the edges; loop without.")] = None,
    mission: MissionOption = None,
    source: Annotated[str, typer.Option(help="Only those that this operator or file gave.")] = "",
    json: JsonFlag = False,
) -> None:
    """Delete loop closures: all, of one kind, of one mission, or of one source; poses stay."""
    folder: Path = context.obj
    kinds = kind or ["loop"]

    def deleted(map_: Map) -> tuple[Map, int]:
        row = None if mission is None else find_mission(map_, mission)
        return tools.delete_loops(map_, kinds=kinds, mission_row=row, source=source)

    num = change_map(folder, "loops delete", deleted, kinds=kinds, mission=mission, source=source)
    if json:
        say_json({"path": folder, "num_deleted": num})
    else:
        say(f"{in_place(folder)}: {num} edges deleted")


def fix_stationary(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Hold robots that stood still by tight edges, so that noise does not let them drift."""
    folder: Path = context.obj
    config = config_from(StationaryConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    report = change_map(
        folder, "fix-stationary", lambda map_: fix_stationary_tool(map_, config), **settings
    )
    if json:
        say_json(report)
    else:
        standing = f"{report.num_standing} of {report.num_stretches} stretches"
        say(f"{in_place(folder)}: a robot stood still in {standing}")
