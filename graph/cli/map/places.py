"""The verb that makes a small map for localisation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.places.summary import SummaryConfig
from mapstream.operators.places.summary import summarize as summarize_tool
from mapstream.recordings.maps import load_map, require_valid, save_map
from mapstream.recordings.maps.combine import with_journal_entry


def summarize(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of the small map.")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write a small map for localisation: keyframes, the best landmarks, what they look like. Also: clsm."""
    folder: Path = context.obj
    config = config_from(SummaryConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    small, report = summarize_tool(require_valid(load_map(folder)), config)
    save_map(require_valid(with_journal_entry(small, "summarize", **settings)), out)
    if json:
        say_json(report)
        return
    size = f"{report.num_landmarks} landmarks, {report.num_descriptors} descriptors"
    say(f"{in_place(out)}: {report.num_vertices} vertices, {size}")
