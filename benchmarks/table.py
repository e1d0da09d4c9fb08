"""The rows that every benchmark returns, and how they are printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One measurement against something else in the same run."""

    what: str
    ours: str  # the figure with its unit
    other: str  # what it is compared with, and its figure
    ratio: float
    bar: str = ""  # what it should reach, for instance "at most 1.05"


def markdown(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| what | mapstream | against | ratio | bar |", "|---|---|---|---|---|"]
    lines += [f"| {r.what} | {r.ours} | {r.other} | {r.ratio:.3g} | {r.bar} |" for r in rows]
    return "\n".join(lines)
