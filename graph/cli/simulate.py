"""`mapstream simulate`: a synthetic recording with its truth inside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel
from rich.progress import track

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.graph.problems import did_you_mean
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.worlds.catalogue import WORLDS, World
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
    count = record_world(WORLDS[world], config, seed, out, has_progress=not json)
    if json:
        say_json({"path": out, "messages": count, "config": config.model_dump(), "seed": seed})
    else:
        say(f"wrote {in_place(out)}: {count} messages, {out.stat().st_size / 1e6:.1f} MB")


def record_world(
    world: World, config: BaseModel, seed: int, out: Path, *, has_progress: bool
) -> int:
    """Write a world's recording, and return how many messages it has."""
    with McapWriter(out) as writer:
        records = world.records(config, seed)
        for record in track(records, "simulating", disable=not has_progress, transient=True):
            writer.write(record.topic, record.message, record.log_ns)
    return writer.num_messages
