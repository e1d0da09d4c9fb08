"""`mapstream simulate`: a synthetic recording with its truth inside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel, ValidationError
from rich.progress import track

from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.graph.document import Positions, read_scalar
from mapstream.graph.problems import GraphError, Position, did_you_mean
from mapstream.graph.validation import problems_of
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.worlds.catalogue import WORLDS, World
from mapstream.streams.errors import ConfigError


def simulate(
    world: Annotated[str, typer.Argument(help="The world: " + ", ".join(WORLDS) + ".")],
    out: Annotated[Path, typer.Argument(help="The MCAP file to write.")],
    *,
    seed: Annotated[int, typer.Option(help="The same seed gives the same recording.")] = 0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the world.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Drive simulated sensors through a synthetic world and record what they see, and the truth."""
    if world not in WORLDS:
        raise ConfigError(f"no world {world!r}{did_you_mean(world, WORLDS)}")
    config = world_config(WORLDS[world], set_ or [])
    count = record_world(WORLDS[world], config, seed, out, has_progress=not json)
    if json:
        say_json({"path": out, "messages": count, "config": config.model_dump(), "seed": seed})
    else:
        say(f"wrote {in_place(out)}: {count} messages, {out.stat().st_size / 1e6:.1f} MB")


def world_config(world: World, sets: list[str]) -> BaseModel:
    """Return a world's options with some of them set, `lidar.beams=16`.

    Raises:
        ConfigError: If there is no such option, or its value is wrong.
    """
    raw: dict[str, Any] = {}
    positions = Positions("--set")
    for text in sets:
        target, equals, value = text.partition("=")
        keys = target.split(".")
        if not equals or not all(keys):
            raise ConfigError(f"--set {text}: expected KEY=VALUE")
        inside = raw
        for key in keys[:-1]:
            inside = inside.setdefault(key, {})
        inside[keys[-1]] = read_scalar(value)
        positions.places[tuple(keys)] = Position(f"--set {text}")
    try:
        return world.config_type.model_validate(raw)
    except ValidationError as error:
        raise GraphError(problems_of(error, world.config_type, (), positions)) from None


def record_world(
    world: World, config: BaseModel, seed: int, out: Path, *, has_progress: bool
) -> int:
    """Write a world's recording, and return how many messages it has."""
    count = 0
    with McapWriter(out) as writer:
        records = world.records(config, seed)
        for record in track(records, "simulating", disable=not has_progress, transient=True):
            writer.write(record.topic, record.message, record.log_ns)
            count += 1
    return count
