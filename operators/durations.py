"""How long something took, over and over, in bounded memory."""

from __future__ import annotations

import math

_STEPS_PER_OCTAVE = 8  # neighbouring bins differ by 9 %
_NUM_BINS = 48 * _STEPS_PER_OCTAVE  # up to 2**48 ns, three days


class Durations:
    """A histogram with logarithmic bins, so that quantiles of any number of calls are within 5 %."""

    __slots__ = ("_bins", "count", "max_ns", "total_ns")

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self.count = 0
        self.total_ns = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        self.count += 1
        self.total_ns += duration_ns
        self.max_ns = max(self.max_ns, duration_ns)
        index = int(math.log2(duration_ns) * _STEPS_PER_OCTAVE) if duration_ns > 0 else 0
        index = min(index, _NUM_BINS)
        self._bins[index] = self._bins.get(index, 0) + 1

    def quantile_ns(self, fraction: float) -> float:
        """Return the duration that this fraction of the calls did not exceed; nan without calls."""
        if self.count == 0:
            return math.nan
        wanted, seen, exponent = fraction * self.count, 0, 0.0
        for index in sorted(self._bins):
            seen += self._bins[index]
            exponent = (index + 0.5) / _STEPS_PER_OCTAVE
            if seen >= wanted:
                break
        return min(math.exp2(exponent), float(self.max_ns))
