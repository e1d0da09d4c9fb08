"""What waits to be drawn, in bounded memory.

Lossless: `put` waits until there is room; for a file, which always gets on.
Else it never waits. Of what comes often (scans, images) only the newest of each output is kept, at most so
many a second, and when memory runs out it goes first; scalars, poses and submaps go last.
Every loss is counted.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from threading import Condition
from typing import Any

from mapstream.recordings.maps import Map
from mapstream.streams.messages import estimates, grids, sensors, vision
from mapstream.streams.sizes import nbytes


class Worth(IntEnum):
    """What the picture loses with a message; the least goes first."""

    SAMPLE = 0  # one of many that look alike
    NEWEST = 1  # each holds all that the one before it held
    EVERY = 2


_WORTH = {
    sensors.LidarScan: Worth.SAMPLE,
    sensors.OrganizedCloud: Worth.SAMPLE,
    sensors.LaserScan2D: Worth.SAMPLE,
    sensors.CameraFrame: Worth.SAMPLE,
    sensors.EncodedImage: Worth.SAMPLE,
    estimates.PointCloud: Worth.SAMPLE,
    vision.ImageFeatures: Worth.SAMPLE,
    estimates.MapCorrection: Worth.NEWEST,
    Map: Worth.NEWEST,
    grids.OccupancyGrid: Worth.NEWEST,
    estimates.Submap: Worth.EVERY,
}
_ITEM_BYTES = 512  # what Python needs around a small message
_LARGE_BYTES = 50_000  # a message of a type that is not listed is a sample if it is larger
_STALL_S = 10.0  # a file that takes nothing for so long is as good as full


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One message on its way to the picture."""

    path: str  # of the output that sent it
    message: Any
    epoch: int
    sequence: int
    num_bytes: int
    worth: Worth


class TapQueue:
    """A queue from the event loop, which puts, to the one thread that draws, which takes.

    Args:
        max_bytes: Of the messages in the queue and the one that is drawn.
        is_lossless: `put` waits for room, and nothing is thinned.
        max_rate_hz: Of samples, per output.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        max_bytes: int,
        *,
        is_lossless: bool = False,
        max_rate_hz: float = 15.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.max_bytes = max_bytes
        self.is_lossless = is_lossless
        self.lost: Counter[tuple[str, str]] = Counter()  # by output and reason
        self.num_bytes = 0
        self.high_water_bytes = 0
        self._period_s = 1 / max_rate_hz
        self._clock = clock
        # By worth, each in the order of arrival: so that no step depends on how much waits.
        self._items: dict[Worth, dict[int, Item]] = {worth: {} for worth in Worth}
        self._replaceable: dict[str, int] = {}  # output -> place of its item that a newer one takes
        self._accepted_s: dict[str, float] = {}
        self._num_put = self._num_taken = 0
        self._drawn_bytes = 0
        self._is_closed = self._is_stalled = False
        self._changed = Condition()

    def __len__(self) -> int:
        return sum(map(len, self._items.values()))

    def put(self, path: str, message: object, epoch: int = 0) -> None:
        """Add a message, or count it as lost."""
        num_bytes = nbytes(message) + _ITEM_BYTES
        worth = Worth.EVERY if self.is_lossless else _worth_of(message, num_bytes)
        with self._changed:
            item = Item(
                path=path,
                message=message,
                epoch=epoch,
                sequence=self._num_put,
                num_bytes=num_bytes,
                worth=worth,
            )
            self._num_put += 1
            if self._is_closed:
                self.lost[path, "closed"] += 1
            elif worth is Worth.SAMPLE and self._comes_too_soon(path):
                self.lost[path, "rate"] += 1
            else:
                self._insert(item)

    def take(self, timeout_s: float) -> Item | None:
        """Remove the oldest message; None if there is none within the time. The one before counts as drawn."""
        with self._changed:
            self.num_bytes -= self._drawn_bytes
            self._drawn_bytes = 0
            self._num_taken += 1
            self._is_stalled = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: len(self) or self._is_closed, timeout_s)
            oldest = [(next(iter(items)), worth) for worth, items in self._items.items() if items]
            if not oldest:
                return None
            place, worth = min(oldest)
            item = self._remove(worth, place)
            self._drawn_bytes = item.num_bytes  # it is alive until it is drawn
            self.num_bytes += item.num_bytes
            return item

    def close(self) -> None:
        """Take no more messages; those in the queue can still be taken."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    @property
    def has_ended(self) -> bool:
        """True if it is closed and empty."""
        return self._is_closed and not len(self)

    def abandon(self) -> None:
        """Count all that was not drawn as lost."""
        with self._changed:
            self._is_closed = True
            for worth, items in self._items.items():
                while items:
                    self._lose_oldest(worth, "not drawn in time")
            self._changed.notify_all()

    def _comes_too_soon(self, path: str) -> bool:
        now_s = self._clock()
        last_s = self._accepted_s.get(path)
        if last_s is not None and now_s - last_s < self._period_s:
            return True
        self._accepted_s[path] = now_s
        return False

    def _wait_for_room(self, num_bytes: int) -> bool:
        """Wait until the item fits or is alone; False if nothing was drawn for long."""
        while self.num_bytes and self.num_bytes + num_bytes > self.max_bytes:
            before = self._num_taken
            if self._is_stalled:
                return False
            self._changed.wait(_STALL_S)
            self._is_stalled = self._num_taken == before
        return True

    def _insert(self, item: Item) -> None:
        if self.is_lossless and not self._wait_for_room(item.num_bytes):
            self.lost[item.path, "memory"] += 1
            return
        items, place = self._items[item.worth], item.sequence
        if item.worth is not Worth.EVERY:
            waiting = self._replaceable.get(item.path)
            if waiting in items:  # the newest takes the place of the one that it outdates
                place = waiting
                self.num_bytes -= items[place].num_bytes
                self.lost[item.path, "newer"] += 1
            self._replaceable[item.path] = place
        items[place] = item
        self.num_bytes += item.num_bytes
        if not self.is_lossless:
            self._shrink()
        self.high_water_bytes = max(self.high_water_bytes, self.num_bytes)
        self._changed.notify_all()

    def _shrink(self) -> None:
        """Lose what is worth least, the oldest first, until the rest fits."""
        for worth, items in self._items.items():
            while items and self.num_bytes > self.max_bytes:
                self._lose_oldest(worth, "memory")

    def _lose_oldest(self, worth: Worth, reason: str) -> None:
        place = next(iter(self._items[worth]))
        self.lost[self._remove(worth, place).path, reason] += 1

    def _remove(self, worth: Worth, place: int) -> Item:
        item = self._items[worth].pop(place)
        self.num_bytes -= item.num_bytes
        return item


def _worth_of(message: object, num_bytes: int) -> Worth:
    for cls in type(message).__mro__:
        if cls in _WORTH:
            return _WORTH[cls]
    return Worth.SAMPLE if num_bytes > _LARGE_BYTES else Worth.EVERY
