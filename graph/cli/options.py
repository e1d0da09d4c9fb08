"""`--set KEY=VALUE` for things that are no graph: worlds, exports, optimisers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import typer
from pydantic import BaseModel, ValidationError

from mapstream.graph.document import Positions, read_scalar
from mapstream.graph.problems import GraphError, Position
from mapstream.graph.validation import problems_of
from mapstream.streams.errors import ConfigError

ConfigT = TypeVar("ConfigT", bound=BaseModel)
KeySetList = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="An option, typed as in YAML."),
]


def config_from(config_type: type[ConfigT], sets: Sequence[str] | None) -> ConfigT:
    """Return options with some of them set: `lidar.beams=16`.

    Raises:
        ConfigError: If there is no such option, or its value is wrong; the message quotes the word.
    """
    raw: dict[str, Any] = {}
    positions = Positions("--set")
    for text in sets or ():
        target, equals, value = text.partition("=")
        keys = target.split(".")
        if not equals or not all(keys):
            raise ConfigError(f"--set {text}: expected KEY=VALUE")
        positions.places[tuple(keys)] = Position(f"--set {text}")
        inside = raw
        for key in keys[:-1]:
            inside = inside.setdefault(key, {})
        try:
            inside[keys[-1]] = read_scalar(value)
        except ValueError as error:
            raise ConfigError(f"--set {text}: {error}") from None
    try:
        return config_type.model_validate(raw)
    except ValidationError as error:
        raise GraphError(problems_of(error, config_type, (), positions)) from None
