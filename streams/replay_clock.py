"""The clock of a replay: any rate, pause, step, seek, a section that loops, a rate that adapts.

Deadlines are absolute, `t0 + (stamp - stamp0) / rate`, so that delays do not add up over a recording.
All methods are called on the event loop that sleeps.
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import anyio

from mapstream.streams.waiting import Waiters

_SLICE_S = 0.02  # a sleep under an adapting rate is no longer, so that it can end early
_POLL_S = 0.002  # how often a full queue is looked at again


@dataclass(slots=True)
class AutoRate:
    """Replay as fast as the slowest operator allows: no queue fills up, nothing is dropped.

    The rate falls while the fullest queue is half full and climbs while it is nearly empty. While it
    is full nothing passes at all.
    """

    fill: Callable[[], float]  # of the fullest queue: 0 is empty, at 1 nothing more may come
    min_rate: float = 0.01
    max_rate: float = 1000.0

    def adapted(self, rate: float) -> float:
        fill = self.fill()
        if fill >= 0.5:
            return max(rate * 0.9, self.min_rate)
        return min(rate * 1.1, self.max_rate) if fill <= 0.3 else rate

    def is_full(self) -> bool:
        return self.fill() >= 1.0


class ReplayClock:
    """Event time that follows a recording; it starts with the first deadline.

    A source waits for each message's stamp with `sleep_until`, then asks `take_seek` before it sends:
    a seek ends all waits at once.
    """

    def __init__(
        self,
        rate: float | None = 1.0,
        *,
        auto: AutoRate | None = None,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], Awaitable[None]] = anyio.sleep,
    ) -> None:
        """Make a clock.

        Args:
            rate: Event time per real time; None is as fast as possible.
            auto: Adapts the rate, which then starts at `rate` or 1.
            monotonic_ns: Real time.
            sleep: Waits for some seconds of real time.
        """
        self._auto = auto
        self._monotonic_ns = monotonic_ns
        self._sleep = sleep
        self._rate: float | None = 1.0
        self._stamp_ns = 0  # event time ...
        self._anchor_ns: int | None = None  # ... at this real time; None while time stands still
        self._is_started = False
        self._is_paused = False
        self._num_steps = 0
        self._seek_ns: int | None = None
        self._section: tuple[int, int] | None = None
        self._deadlines_ns: list[int] = []
        self._changed = Waiters()
        self._naps: set[anyio.CancelScope] = set()
        self._last: tuple[int, int] | None = None  # event and real time accounted for
        self._played_ns = 0
        self._running_ns = 0
        self.set_rate(rate)

    @property
    def rate(self) -> float | None:
        """Event time per real time that is aimed at; None is as fast as possible."""
        return self._rate

    @property
    def is_adapting(self) -> bool:
        """True if the rate follows the queues."""
        return self._auto is not None

    @property
    def is_paused(self) -> bool:
        return self._is_paused

    @property
    def section(self) -> tuple[int, int] | None:
        """First and last stamp of the section that loops."""
        return self._section

    @property
    def achieved_rate(self) -> float:
        """Event time per real time up to the last deadline, without pauses; 0 before the second."""
        return self._played_ns / self._running_ns if self._running_ns else 0.0

    def now_ns(self) -> int:
        """Return event time; as fast as possible it is that of the newest deadline passed."""
        if self._anchor_ns is None or self._rate is None:
            return self._stamp_ns
        return self._stamp_ns + round((self._monotonic_ns() - self._anchor_ns) * self._rate)

    def set_rate(self, rate: float | None) -> None:
        """Go on from here at another rate.

        Raises:
            ValueError: If the rate is not positive.
        """
        if rate is not None and not rate > 0:
            raise ValueError(f"a replay rate is positive, not {rate}")
        self._stamp_ns = self.now_ns()
        self._anchor_ns = self._monotonic_ns() if self._runs() else None
        self._rate = 1.0 if rate is None and self._auto else rate
        self._interrupt()

    def pause(self) -> None:
        """Freeze time: no deadline passes."""
        if not self._is_paused:
            self._stamp_ns = self.now_ns()
            self._account(self._stamp_ns)
            self._anchor_ns = self._last = None
            self._is_paused = True
            self._interrupt()

    def resume(self) -> None:
        """Go on where `pause` stopped."""
        self._is_paused = False
        self._num_steps = 0
        if self._is_started and self._anchor_ns is None:
            self._anchor_ns = self._monotonic_ns()
            self._last = (self._stamp_ns, self._anchor_ns)
        self._interrupt()

    def step(self) -> None:
        """Pause, and let the one earliest deadline pass."""
        self.pause()
        self._num_steps += 1
        self._interrupt()

    def seek(self, stamp_ns: int) -> None:
        """Ask the source to go on from another stamp; it picks this up with `take_seek`."""
        self._seek_ns = stamp_ns
        self._interrupt()

    def take_seek(self) -> int | None:
        """Return the stamp that was asked for, once; time starts anew at the next deadline."""
        target_ns, self._seek_ns = self._seek_ns, None
        if target_ns is not None:
            self._stamp_ns = target_ns
            self._is_started = False
            self._anchor_ns = self._last = None
        return target_ns

    def loop(self, start_ns: int, end_ns: int) -> None:
        """Play a section over and over, both ends included.

        Raises:
            ValueError: If the section is empty.
        """
        if end_ns < start_ns:
            raise ValueError(f"a section cannot end at {end_ns} before it starts at {start_ns} ns")
        self._section = (start_ns, end_ns)
        self.seek(start_ns)

    def stop_loop(self) -> None:
        """Play on past the end of the section."""
        self._section = None

    async def sleep_until(self, stamp_ns: int) -> None:
        """Wait until event time reaches a stamp, or a seek is asked for."""
        if self._section is not None and stamp_ns > self._section[1]:
            self.seek(self._section[0])
        self._deadlines_ns.append(stamp_ns)
        try:
            while self._seek_ns is None and not self._may_pass(stamp_ns):
                await self._wait(stamp_ns)
        finally:
            self._deadlines_ns.remove(stamp_ns)

    def _runs(self) -> bool:
        return self._is_started and not self._is_paused

    def _may_pass(self, stamp_ns: int) -> bool:
        """Let a deadline pass if it is due."""
        if self._is_paused:
            if self._num_steps == 0 or stamp_ns > min(self._deadlines_ns):
                return False
            self._num_steps -= 1
            self._stamp_ns = stamp_ns
            self._is_started = True
            return True
        if self._auto is not None and self._auto.is_full():
            self._hold_at(min(self._deadlines_ns))
            return False
        if not self._is_started:
            self._stamp_ns, self._anchor_ns = stamp_ns, self._monotonic_ns()
            self._is_started = True
        if self._rate is None:
            self._stamp_ns = max(self._stamp_ns, stamp_ns)
        elif self.now_ns() < stamp_ns:
            return False
        self._account(stamp_ns)
        self._adapt()
        return True

    def _hold_at(self, stamp_ns: int) -> None:
        """Let no time pass that would have to be made up for in one burst."""
        if self._is_started and self.now_ns() > stamp_ns:
            self._stamp_ns, self._anchor_ns = stamp_ns, self._monotonic_ns()

    async def _wait(self, stamp_ns: int) -> None:
        if self._is_paused:
            await self._changed.wait()
            return
        left_ns = max(0, stamp_ns - self.now_ns())  # time went on since it was looked at
        left_s = left_ns / 1e9 / (self._rate or 1.0)
        is_held = self._auto is not None and self._auto.is_full()
        if self._auto is not None:
            left_s = _POLL_S if is_held else min(left_s, _SLICE_S)
        with anyio.CancelScope() as nap:
            self._naps.add(nap)
            try:
                await self._sleep(left_s)
            finally:
                self._naps.discard(nap)
        if not is_held:
            self._adapt()

    def _adapt(self) -> None:
        if self._auto is not None and self._rate is not None:
            rate = self._auto.adapted(self._rate)
            if rate != self._rate:
                self.set_rate(rate)

    def _account(self, stamp_ns: int) -> None:
        real_ns = self._monotonic_ns()
        if self._last is not None:
            self._played_ns += max(0, stamp_ns - self._last[0])
            self._running_ns += real_ns - self._last[1]
        self._last = (stamp_ns, real_ns)

    def _interrupt(self) -> None:
        """End all waits, so that they look at the time again."""
        self._changed.wake()
        for nap in self._naps:
            nap.cancel()
