"""`mapstream simulate`: a synthetic recording with its truth inside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, fraction_bar, in_place, say, say_json
from mapstream.graph.problems import did_you_mean
from mapstream.recordings.worlds import catalogue
from mapstream.recordings.worlds.catalogue import WORLDS
from mapstream.streams.errors import ConfigError


def simulate(
    world: Annotated[str, typer.Argument(help="The world: " + ", ".join(WORLDS) + ".")],
    out: Annotated[Path, typer.Argument(help="The MCAP file to write.")],
    *,
    seed: Annotated[int, typer.Option(help="The same seed gives the same recording.")] = 0,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Drive simulated sensors through a synthetic world and record what they see, and the truth."""
    if world not in WORLDS:
        raise ConfigError(f"no world {world!r}{did_you_mean(world, WORLDS)}")
    config = config_from(WORLDS[world].config_type, set_)
    write_world(world, out, config, seed=seed)
    num_bytes = out.stat().st_size
    if json:
        say_json({"path": out, "bytes": num_bytes, "config": config.model_dump(), "seed": seed})
    else:
        say(f"wrote {in_place(out)}: {num_bytes / 1e6:.1f} MB")


def write_world(world: str, out: Path, config: BaseModel, *, seed: int) -> None:
    """Write a world's recording, with a bar on a terminal."""
    options = config.model_dump(exclude_unset=True)
    with fraction_bar("simulating") as show:
        catalogue.simulate(world, out, seed=seed, on_progress=show, **options)
