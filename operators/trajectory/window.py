"""The stamps at which measurements ask for poses, held until nothing can come before them any more."""

from __future__ import annotations

from bisect import insort

from mapstream.streams.join import END
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.vision import ImageFeatures, NFrame

Seen = PointCloud | NFrame
View = tuple[PointCloud | None, tuple[ImageFeatures, ...]]
"""What a pose sees: a cloud, and features of cameras."""


class CommitWindow:
    """Measurement queueing (Trevor et al., OmniMapper, ICRA 2014, section III-C)."""

    def __init__(self, window_ns: int | None) -> None:
        """Wait for measurements that are up to so late; None: hold all until the end."""
        self._window_ns = window_ns
        self._stamps_ns: list[int] = []  # in order
        self._constraints: dict[int, list[Constraint]] = {}
        self._seen: dict[int, View] = {}

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def ask(self, stamp_ns: int) -> list[Constraint]:
        """Ask for a pose, and return what is known of it so far, to be added to."""
        if stamp_ns not in self._constraints:
            insort(self._stamps_ns, stamp_ns)
            self._constraints[stamp_ns] = []
        return self._constraints[stamp_ns]

    def see(self, seen: Seen) -> None:
        """Ask for a pose where a cloud or an n-frame was seen."""
        self.ask(seen.stamp_ns)
        cloud, features = self._seen.get(seen.stamp_ns, (None, ()))
        if isinstance(seen, PointCloud):
            self._seen[seen.stamp_ns] = (seen, features)
        else:
            self._seen[seen.stamp_ns] = (cloud, seen.features)

    def waited(self, known_ns: int) -> list[int]:
        """Return the stamps that waited long enough, in order.

        Args:
            known_ns: The newest stamp of all that was heard; `END` at the end.
        """
        if known_ns >= END:
            return list(self._stamps_ns)
        if self._window_ns is None:
            return []
        last_ns = known_ns - self._window_ns
        return [stamp_ns for stamp_ns in self._stamps_ns if stamp_ns <= last_ns]

    def take(self, stamp_ns: int) -> tuple[list[Constraint], View]:
        """Return what was measured and what was seen at the oldest stamp, and forget it."""
        self._stamps_ns.remove(stamp_ns)
        return self._constraints.pop(stamp_ns), self._seen.pop(stamp_ns, (None, ()))
