"""Problems of a graph file: each with its place and key path, all told at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from mapstream.streams.errors import ConfigError

KeyPath = tuple[str | int, ...]  # of keys, from the top of the file


@dataclass(frozen=True, slots=True)
class Position:
    """Where something was written: a place in a file, or an option of the command line."""

    source: str
    line: int | None = None  # from 1
    column: int | None = None

    def __str__(self) -> str:
        return ":".join(str(part) for part in (self.source, self.line, self.column) if part)


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong."""

    position: Position
    path: KeyPath
    message: str

    def __str__(self) -> str:
        where = dotted(self.path)
        return (
            f"{self.position}: {where}: {self.message}"
            if where
            else f"{self.position}: {self.message}"
        )


class GraphError(ConfigError):
    """A graph file with problems; the message has one line for each."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = tuple(problems)


def dotted(path: KeyPath) -> str:
    """Return `operators.odometry.config.voxel_size_m` for a path of keys."""
    return ".".join(map(str, path))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a hint on a word that is not among the known ones; it starts with `; `."""
    names = sorted(known)
    close = get_close_matches(word, names, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"; there is {shown}" if names else ""
