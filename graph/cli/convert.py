"""`mapstream convert`: data sets and bags as MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.output import JsonFlag, fraction_bar, in_place, say, say_json
from mapstream.recordings.datasets import catalogue
from mapstream.recordings.datasets.catalogue import CONVERTERS


def convert(
    source: Annotated[
        str,
        typer.Argument(
            help="KIND:PATH, or KIND alone where the data is installed. "
            + ". ".join(f"{k}: {c.summary}" for k, c in CONVERTERS.items())
            + "."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="The MCAP file to write.")],
    *,
    json: JsonFlag = False,
) -> None:
    """Rewrite a data set or a bag as an MCAP recording."""
    with fraction_bar("converting") as show:
        done = catalogue.convert(source, out, on_progress=show)
    if json:
        say_json(done)
        return
    size = f"{out.stat().st_size / 1e6:.1f} MB"
    say(f"wrote {in_place(out)}: {done.num_messages} messages, {size}")
    for notice in done.notices:
        say(f"note: {notice}")
