"""The verb that takes what moved out of a map's clouds."""

from __future__ import annotations

from pathlib import Path

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, fraction_bar, in_place, say, say_json
from mapstream.operators.dense.moving import MovingConfig, remove_moving
from mapstream.recordings.maps.history import change_map


def remove_moving_(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Take out of the clouds what moved while they were recorded, and what later missions found gone."""
    folder: Path = context.obj
    config = config_from(MovingConfig, set_)
    with fraction_bar("looking through") as show:
        report = change_map(
            folder,
            "remove_moving",
            lambda map_: remove_moving(map_, folder, config, show),
            **config.model_dump(mode="json"),
        )
    if json:
        say_json(report)
        return
    share = 100 * report.num_moving / max(report.num_points, 1)
    clouds = f"{report.num_moving} of {report.num_points} points ({share:.1f} %) of {report.num_clouds} clouds"
    say(f"{in_place(folder)}: took out {clouds}")
