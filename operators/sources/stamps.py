"""What can be wrong with the stamps of a topic, found while it plays."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

_UNITS: Final = {1_000: "microseconds", 1_000_000: "milliseconds", 1_000_000_000: "seconds"}
_DATE_NS: Final = 10**17  # 1973; log times below are not dates, and units cannot be told


@dataclass(slots=True)
class StampWatch:
    """Follows the stamps of one topic and counts what is odd about them, by name."""

    topic: str
    max_jump_ns: int
    notices: Counter[str] = field(default_factory=Counter)
    offset_ns: int | None = None  # of the newest stamp against its log time
    least_offset_ns: int = 0
    _last_ns: int | None = None
    _texts: dict[str, str] = field(default_factory=dict)  # what was odd -> that, and where first

    def note(self, what: str, log_ns: int) -> None:
        """Count something odd; the notice says where it came first."""
        text = self._texts.setdefault(what, f"{self.topic}: {what}, first at log time {log_ns} ns")
        self.notices[text] += 1

    def see(self, stamp_ns: int, log_ns: int) -> bool:
        """Take note of one message; True if its clock jumped since the last one."""
        offset_ns = stamp_ns - log_ns
        if self.offset_ns is None:
            self._check_unit(stamp_ns, log_ns)
            self.least_offset_ns = offset_ns
        elif abs(offset_ns - self.offset_ns) > self.max_jump_ns:
            way = "forward" if offset_ns > self.offset_ns else "backward"
            self.note(f"its clock jumps {way}", log_ns)
            self.restart()
            self.see(stamp_ns, log_ns)
            return True
        if self._last_ns is not None and stamp_ns < self._last_ns:
            self.note("stamps run backwards", log_ns)
        elif stamp_ns == self._last_ns:
            self.note("stamps repeat", log_ns)
        self.offset_ns = offset_ns
        self.least_offset_ns = min(self.least_offset_ns, offset_ns)
        self._last_ns = stamp_ns
        return False

    def restart(self) -> None:
        """Forget what came before: a new epoch begins."""
        self.offset_ns = self._last_ns = None
        self.least_offset_ns = 0

    def _check_unit(self, stamp_ns: int, log_ns: int) -> None:
        if log_ns < _DATE_NS:
            return
        for factor, unit in _UNITS.items():
            if 0.5 < stamp_ns * factor / log_ns < 2:
                self.notices[f"{self.topic}: stamps are in {unit}, not nanoseconds"] += 1
            if 0.5 < stamp_ns / factor / log_ns < 2:
                self.notices[f"{self.topic}: stamps are {factor} times too large"] += 1
