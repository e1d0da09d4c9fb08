"""Factors written in Python, for measurements that gtsam has no factor for; each costs 20 us instead of 1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam

from mapstream.streams.arrays import FloatArray

Residual = Callable[[Any, Sequence[int], list[FloatArray] | None], FloatArray]
"""From gtsam's values, the keys, and a list for the Jacobians by key, to the error (M,).

The list is None where no Jacobians are wanted; otherwise it has an entry (M, dim) to set for each key.
"""


class OwnFactor(gtsam.CustomFactor):
    """A residual on some variables; robust losses and switches work on it as on any factor."""

    def __init__(self, noise: Any, keys: Sequence[int], residual: Residual) -> None:  # noqa: ANN401
        self.residual = residual
        self.ends = tuple(keys)
        ends = self.ends  # not self: a factor that refers to itself is never freed
        super().__init__(
            noise, list(keys), lambda _, values, jacobians: residual(values, ends, jacobians)
        )

    def cloneWithNewNoiseModel(self, noise: Any) -> OwnFactor:  # noqa: ANN401
        """Return the same residual with another noise model; gtsam's own method cannot."""
        return OwnFactor(noise, self.ends, self.residual)
