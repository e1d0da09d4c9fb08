"""Using some messages, by their stamps: the first in each stretch of time, or those far enough apart."""

from __future__ import annotations


class Period:
    """Stretches of time that follow each other, so that one message in each is used on average, whatever their rate."""

    def __init__(self, period_s: float) -> None:
        """Make stretches; 0: each message has one of its own."""
        self._period_ns = round(period_s * 1e9)
        self._due_ns: int | None = None

    def begins(self, stamp_ns: int) -> bool:
        """Return whether a message, asked for in order, is the first of its stretch."""
        if self._due_ns is not None and stamp_ns < self._due_ns:
            return False
        late_ns = 0 if self._due_ns is None else stamp_ns - self._due_ns
        self._due_ns = stamp_ns + self._period_ns - late_ns % max(self._period_ns, 1)
        return True


class Spacing:
    """So much time at least between messages that are used; the first one is."""

    def __init__(self, period_s: float) -> None:
        """Ask for a time; 0: each message is used."""
        self._period_ns = period_s * 1e9
        self._used_ns: int | None = None

    def allows(self, stamp_ns: int) -> bool:
        """Return whether a message, asked for in order, is far enough from the last one used, and use it."""
        if self._used_ns is not None and stamp_ns - self._used_ns < self._period_ns:
            return False
        self._used_ns = stamp_ns
        return True
