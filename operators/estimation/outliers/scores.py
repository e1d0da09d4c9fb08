"""How well an optimiser told false loops from true ones, where somebody labelled them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray
from mapstream.streams.errors import RecordingError


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopScore:
    """How well false loops were told from true ones."""

    precision: float  # of the loops that were kept, how many are true
    recall: float  # of the true loops, how many were kept
    num_false: int
    num_false_kept: int
    num_true_dropped: int


def score_loops(map_: Map, is_false: BoolArray) -> LoopScore:
    """Compare the switches of edges with labels that say which are false.

    Args:
        map_: With the switches that an optimiser gave.
        is_false: Of its first edges; those beyond, which were added to what was labelled, do not count.

    Raises:
        RecordingError: If there are more labels than edges.
    """
    if len(is_false) > len(map_.edges):
        raise RecordingError(f"{len(is_false)} labels for a map of {len(map_.edges)} edges")
    may_switch = map_.edges.is_switchable[: len(is_false)]
    kept = map_.edges.switch[: len(is_false)][may_switch] >= 0.5
    false = np.asarray(is_false, dtype=bool)[may_switch]
    num_kept, num_true = int(kept.sum()), int((~false).sum())
    true_kept = int((kept & ~false).sum())
    return LoopScore(
        precision=true_kept / num_kept if num_kept else 1.0,
        recall=true_kept / num_true if num_true else 1.0,
        num_false=int(false.sum()),
        num_false_kept=num_kept - true_kept,
        num_true_dropped=num_true - true_kept,
    )


def read_labels(path: Path) -> BoolArray:
    """Read which edges (N,) are false: a line each of a number, from 0, and 0 or 1.

    Raises:
        RecordingError: If the file cannot be read, or is not made of such lines.
    """
    try:
        rows = np.loadtxt(path, dtype=np.int64, ndmin=2)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: expected lines of a number and 0 or 1: {error}") from error
    if rows.shape[1:] != (2,) or not np.array_equal(rows[:, 0], np.arange(len(rows))):
        raise RecordingError(f"{path}: expected lines of a number, counted from 0, and 0 or 1")
    is_false: BoolArray = rows[:, 1] == 1
    return is_false
