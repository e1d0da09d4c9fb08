"""`mapstream batch`: map commands from a file, one after another."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from mapstream.graph.cli.output import complain, say
from mapstream.graph.document import Document, read_document
from mapstream.graph.problems import GraphError, Position, Problem, did_you_mean
from mapstream.streams.errors import ConfigError

VERSION = 1
_KEYS = ("version", "maps", "commands")


@dataclass(frozen=True, slots=True)
class Step:
    """One command and where it stands."""

    position: Position
    words: tuple[str, ...]  # what follows `mapstream map`

    def __str__(self) -> str:
        return shlex.join(("mapstream", "map", *self.words))


def batch(
    file: Annotated[Path, typer.Argument(help="YAML with maps and commands.")],
    *,
    dry_run: Annotated[bool, typer.Option(help="Print the commands and run none.")] = False,
) -> None:
    """Run the map commands of a file in order, and stop at the first that fails, with its exit code.

    The file names maps and lists what would follow `mapstream map`, where `$name` is a map's folder:

        version: 1
        maps: {morning: maps/morning, evening: maps/evening}
        commands:
          - $morning merge $evening
          - $morning optimize --set start=chordal
          - $morning check
    """
    from mapstream.graph.cli import main  # noqa: PLC0415  # it imports verbs, such as this one

    for step in read_steps(file):
        say(f"$ {step}")
        if dry_run:
            continue
        try:
            main(("map", *step.words))
        except SystemExit as left:
            if left.code:
                complain(f"{step.position}: {step} failed; what came before it is done")
                raise


def read_steps(file: Path) -> list[Step]:
    """Return the commands of a file, with names replaced by folders.

    Raises:
        ConfigError: If the file cannot be read, or says something else; with file and line.
    """
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    document = read_document(text, str(file))
    data = document.data
    if not isinstance(data, dict) or data.get("version") != VERSION:
        _refuse(document, (), f"expected a batch file, `version: {VERSION}` with maps and commands")
    for key in data:
        if key not in _KEYS:
            _refuse(document, (key,), f"unknown key{did_you_mean(str(key), _KEYS)}")
    maps, commands = data.get("maps") or {}, data.get("commands")
    if not isinstance(maps, dict) or not all(isinstance(each, str) for each in maps.values()):
        _refuse(document, ("maps",), "expected a folder by name")
    if not isinstance(commands, list) or not commands:
        _refuse(document, ("commands",), "expected a list of commands")
    return [_step(document, number, maps) for number in range(len(commands))]


def _step(document: Document, number: int, maps: dict[str, str]) -> Step:
    path = ("commands", number)
    command = document.data["commands"][number]
    if not isinstance(command, str) or not command.strip():
        _refuse(document, path, f"expected a command such as `$name check`, got {command!r}")
    try:
        words = shlex.split(command)
    except ValueError as error:
        _refuse(document, path, f"cannot be split into words: {error}")
    for at, word in enumerate(words):
        if word.startswith("$"):
            if word[1:] not in maps:
                _refuse(
                    document, path, f"no map is named {word[1:]!r}{did_you_mean(word[1:], maps)}"
                )
            words[at] = maps[word[1:]]
    return Step(document.positions.of(path), tuple(words))


def _refuse(document: Document, path: tuple[Any, ...], message: str) -> NoReturn:
    raise GraphError([Problem(document.positions.of(path), path, message)])
