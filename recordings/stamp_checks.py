"""What is wrong with the times of one topic, or of one topic against the others."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median_low
from typing import Final, Literal

import numpy as np

from mapstream.streams.arrays import IntArray

_UNITS: Final = {1_000: "microseconds", 1_000_000: "milliseconds", 1_000_000_000: "seconds"}
_JUMP_NS: Final = 10**9  # of a clock against the log time
_OFFSET_NS: Final = 500_000_000  # of a topic's clock against those of the others
_GAP_PERIODS: Final = 5.0
_LEAST_GAP_NS: Final = 50_000_000
_LEAST_DATE_NS: Final = 10**17  # 1973; times below are of no calendar


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong, or worth knowing, with a name that programs can rely on."""

    name: str
    topic: str  # empty: of the whole file
    text: str
    severity: Literal["warning", "note"] = "warning"


@dataclass(frozen=True, slots=True, kw_only=True)
class Times:
    """The times of one topic, in the order of the recording."""

    topic: str
    log_ns: IntArray  # (N,)
    stamps_ns: IntArray  # (N,) of the headers

    @property
    def offset_ns(self) -> float:
        """Return by how much stamps are ahead of the log time, in the middle."""
        return float(np.median(self.stamps_ns - self.log_ns)) if len(self.log_ns) else 0.0

    @property
    def period_ns(self) -> float:
        """Return the usual time between two messages; nan where fewer than three say nothing."""
        return float(np.median(np.diff(self.log_ns))) if len(self.log_ns) > 2 else float("nan")


def check_times(times: Times) -> list[Finding]:
    """Look at one topic alone: zero, wrong unit, backwards, repeated, jumping stamps, and gaps."""

    def finding(name: str, text: str) -> Finding:
        return Finding(name=name, topic=times.topic, text=text)

    found = []
    is_zero = times.stamps_ns <= 0
    if is_zero.any():
        found.append(finding("zero_stamps", f"{is_zero.sum()} stamps are zero; try `stamp: log`"))
    stamps_ns, log_ns = times.stamps_ns[~is_zero], times.log_ns[~is_zero]
    unit = wrong_unit(stamps_ns, log_ns)
    if unit:
        found.append(finding("unit_error", f"stamps {unit}"))
    steps = np.diff(stamps_ns)
    offsets = np.diff(stamps_ns - log_ns)
    jumps = np.flatnonzero(np.abs(offsets) > _JUMP_NS)
    is_jump = np.abs(offsets) > _JUMP_NS
    if len(jumps) and not unit:
        largest = offsets[jumps[np.argmax(np.abs(offsets[jumps]))]] / 1e9
        where = _seconds(log_ns[jumps[0] + 1] - log_ns[0])
        text = f"the clock jumps {len(jumps)} times, by up to {largest:+.3f} s, first at {where}"
        found.append(finding("stamp_jump", text))
    num_backwards = int(((steps < 0) & ~is_jump).sum())
    if num_backwards:
        worst = -int(steps[~is_jump].min()) / 1e9
        text = f"{num_backwards} stamps run backwards, by up to {worst:.6f} s"
        found.append(finding("backwards_stamps", text))
    num_repeated = int((steps == 0).sum())
    if num_repeated:
        found.append(finding("duplicate_stamps", f"{num_repeated} stamps repeat the one before"))
    return found + _gaps(times)


def _gaps(times: Times) -> list[Finding]:
    period_ns = times.period_ns
    if not period_ns > 0:
        return []
    steps = np.diff(times.log_ns)
    gaps = np.flatnonzero(steps > max(_GAP_PERIODS * period_ns, _LEAST_GAP_NS))
    if not len(gaps):
        return []
    longest = gaps[np.argmax(steps[gaps])]
    where = _seconds(times.log_ns[longest] - times.log_ns[0])
    text = f"{len(gaps)} gaps, the longest {_seconds(steps[longest])} at {where}"
    return [Finding(name="gap", topic=times.topic, text=text)]


def wrong_unit(stamps_ns: IntArray, log_ns: IntArray) -> str:
    """Return what unit stamps are in if it is not nanoseconds, as the log times tell; else nothing."""
    if not len(stamps_ns) or log_ns[0] < _LEAST_DATE_NS:
        return ""
    ratio = float(np.median(stamps_ns)) / float(np.median(log_ns))
    for factor, unit in _UNITS.items():
        if 0.5 < ratio * factor < 2:
            return f"are in {unit}, not nanoseconds"
        if 0.5 < ratio / factor < 2:
            return f"are {factor} times too large"
    return ""


def check_offsets(topics: list[Times]) -> list[Finding]:
    """Compare the clocks of all topics: one that is ahead of the others cannot be joined with them."""
    usable = [
        t
        for t in topics
        if len(t.log_ns) and (t.stamps_ns > 0).any() and not wrong_unit(t.stamps_ns, t.log_ns)
    ]
    # with two topics nobody knows which one is wrong: then the log time decides
    is_vote = len(usable) > 2
    reference_ns = median_low(times.offset_ns for times in usable) if is_vote else 0.0
    against = "the other topics" if is_vote else "the log time"
    found = []
    for times in usable:
        ahead_s = (times.offset_ns - reference_ns) / 1e9
        if abs(ahead_s) * 1e9 > _OFFSET_NS:
            way = "ahead of" if ahead_s > 0 else "behind"
            text = (
                f"its clock is {abs(ahead_s):.3f} s {way} {against}; try `offset_s: {-ahead_s:.3f}`"
            )
            found.append(Finding(name="clock_offset", topic=times.topic, text=text))
    return found


def _seconds(duration_ns: float) -> str:
    return f"{duration_ns / 1e9:.3f} s"
