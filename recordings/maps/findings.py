"""What a rule returns: the rows of one table that break it, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray

Sentence = str | Callable[[int], str]  # one for all rows, or made for a row


@dataclass(frozen=True, slots=True)
class Finding:
    """Rows of a table that break a rule."""

    table: str
    rows: IntArray  # (N,)
    sentence: Sentence

    def say(self, row: int) -> str:
        return self.sentence if isinstance(self.sentence, str) else self.sentence(row)


Rule = Callable[[Map], Iterable[Finding]]


def where(is_broken: BoolArray, table: str, sentence: Sentence) -> Iterable[Finding]:
    """Return the rows where the mask is true, as a finding; nothing if there are none."""
    return [Finding(table, np.flatnonzero(is_broken), sentence)] if is_broken.any() else []
