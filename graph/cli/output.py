"""How verbs speak: a short report for people, JSON for programs, an exit code for both."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table


class ExitCode(IntEnum):
    COMPLETE = 0
    FAILED = 1
    UNUSABLE = 2  # the graph or the arguments
    LOSSY = 3


JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON document for programs.")]
ParamList = Annotated[
    list[str] | None,
    typer.Option("--param", metavar="NAME=VALUE", help="A parameter of the graph."),
]
SetList = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="OPERATOR.KEY=VALUE", help="An option of an operator."),
]
ProfileName = Annotated[str, typer.Option("--profile", help="replay, live, or one of the graph's.")]

_WIDE = 160  # columns where no terminal says how many there are

_out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else _WIDE)
_err = Console(stderr=True, highlight=False, soft_wrap=True)


def say(text: str = "") -> None:
    """Print a line of a report."""
    _out.print(escape(text))


def say_aside(text: str) -> None:
    """Print a line that is not the report, such as a choice that was made: to standard error."""
    _err.print(escape(text), style="dim")


def complain(text: str) -> None:
    """Print what is wrong."""
    _err.print(escape(text), style="red")


def say_json(value: object) -> None:
    """Print one JSON document."""
    typer.echo(json.dumps(plain(value), indent=2))


def say_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print rows under headings; numbers stand to the right."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for i, name in enumerate(columns):
        is_number = bool(rows) and all(isinstance(row[i], (int, float)) for row in rows)
        table.add_column(escape(name), justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        table.add_row(*(escape(_cell(cell)) for cell in row))
    _out.print(table, soft_wrap=False)


@contextmanager
def fraction_bar(what: str) -> Iterator[Callable[[float], None]]:
    """Show a bar on a terminal; yields what takes the fraction that is done."""
    from rich.progress import Progress  # noqa: PLC0415  # not for every verb

    with Progress(console=_err, transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda fraction: progress.update(task, completed=fraction)


def plain(value: object) -> Any:  # noqa: ANN401  # of a JSON document
    """Return a value as JSON knows it: dataclasses and arrays unfolded, nan as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # of numpy
        return plain(value.tolist())
    return _plain_leaf(value)


def _plain_leaf(value: object) -> str | int | float | None:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return value.__name__ if isinstance(value, type) else str(value)


def given(texts: Sequence[str] | None, option: str) -> dict[str, str]:
    """Return `NAME=VALUE` options as a mapping.

    Raises:
        typer.BadParameter: If one is not written so.
    """
    result = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise typer.BadParameter(f"expected NAME=VALUE, found {text!r}", param_hint=option)
        result[name] = value
    return result


def in_place(path: Path) -> str:
    """Return a path from the working directory, if it lies there."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return "-" if value is None else str(value)
