"""How well a score tells true places from false ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_MOST_POINTS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class RocPoint:
    """What a threshold on the score would do."""

    score: float  # candidates with at least so much are taken
    true_rate: float  # of the true candidates that are taken
    false_rate: float  # of the false ones


def roc(scores: Sequence[float], is_true: Sequence[bool]) -> list[RocPoint]:
    """Return up to twenty points of the curve, from the highest score down; none without both sorts."""
    score, true = np.asarray(scores, np.float64), np.asarray(is_true, bool)
    if not true.any() or true.all():
        return []
    thresholds = np.unique(score)[::-1]
    chosen = np.unique(np.linspace(0, len(thresholds) - 1, _MOST_POINTS).round().astype(int))
    return [
        RocPoint(
            score=threshold,
            true_rate=float((score[true] >= threshold).mean()),
            false_rate=float((score[~true] >= threshold).mean()),
        )
        for threshold in thresholds[chosen].tolist()
    ]


def area_under(points: Sequence[RocPoint]) -> float:
    """Return the area under a curve: the chance that a true candidate scores higher than a false one."""
    false = [0.0, *(p.false_rate for p in points), 1.0]
    true = [0.0, *(p.true_rate for p in points), 1.0]
    return float(np.trapezoid(true, false))
