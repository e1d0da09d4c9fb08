"""What surveyors and geographic programs take from a map: tiles, heights, pictures from above."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.maps.cloud_tiles import TilesConfig, write_tiles
from mapstream.operators.maps.elevation import (
    ElevationConfig,
    elevation,
    write_elevation,
    write_orthomosaic,
)
from mapstream.recordings.maps import load_map


def tiles(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(help="The folder to write.")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write the cloud of all keyframes as square LAZ tiles with an index, in bounded memory."""
    folder: Path = context.obj
    report = write_tiles(load_map(folder), folder, out, config_from(TilesConfig, set_))
    if json:
        say_json(report)
        return
    place = report.crs or "the map frame"
    say(
        f"wrote {in_place(out)}: {len(report.files) - 1} tiles, {report.num_points} points in {place}"
    )


def elevation_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="A .tif of heights in metres.")],
    *,
    orthomosaic: Annotated[
        Path | None, typer.Option(help="Also the colours from above, a .png or .tif.")
    ] = None,
    set_: KeySetList = None,
) -> None:
    """Write the height of the ground as a grid with its place, and the colours seen from above."""
    folder: Path = context.obj
    grid = elevation(load_map(folder), folder, config_from(ElevationConfig, set_))
    files = write_elevation(grid, file)
    if orthomosaic is not None:
        files += write_orthomosaic(grid, orthomosaic)
    for path in files:
        say(f"wrote {in_place(path)}")
