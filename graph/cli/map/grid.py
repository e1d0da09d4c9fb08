"""The verb that makes a floor plan of a map, for robots that drive by one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.laser.map_grid import GridConfig, map_grid
from mapstream.recordings.grid_files import write_grid
from mapstream.recordings.maps import load_map


def grid(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The YAML file; its image is written beside it.")],
    *,
    resolution_m: Annotated[float | None, typer.Option(help="Side of a cell [m].")] = None,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write an occupancy grid of the clouds of the keyframes, as ROS' map_server reads it."""
    folder: Path = context.obj
    given = [] if resolution_m is None else [f"resolution_m={resolution_m}"]
    config = config_from(GridConfig, [*given, *(set_ or [])])
    made, report = map_grid(load_map(folder), folder, config)
    files = write_grid(file, made)
    if json:
        say_json({"files": files, "report": report})
        return
    say(f"wrote {in_place(files[0])} and {files[1].name}")
    for line in report.lines():
        say(line)
