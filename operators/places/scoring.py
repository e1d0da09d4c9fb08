"""How likely it is that a frame was taken where a vertex of the map was, by the votes of its matches.

Source: Gehrig, Stumm, Hinzmann, Siegwart, Visual place recognition with probabilistic voting, ICRA 2017.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray

Scoring = Literal["probability", "votes"]


def scores(
    scoring: Scoring, votes: IntArray, num_descriptors: IntArray, num_all: int
) -> FloatArray:
    """Return a score for each vertex (V,): the higher, the likelier.

    Args:
        scoring: `votes` counts them. `probability` is -ln of the probability that chance alone gives a vertex so
            many votes or more, where each vote falls on each descriptor of the map alike; vertices that see
            much get many votes by chance.
        votes: Of each vertex (V,).
        num_descriptors: That each vertex has in the map (V,).
        num_all: Descriptors in the map.
    """
    if scoring == "votes":
        return votes.astype(np.float64)
    from scipy.stats import binom  # noqa: PLC0415  # slow to import

    logs: FloatArray = -binom.logsf(votes - 1, int(votes.sum()), num_descriptors / num_all)
    return logs
