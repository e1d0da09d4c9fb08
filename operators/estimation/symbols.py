"""Trajectory management of OmniMapper (Trevor et al., ICRA 2014, section III-C): one symbol per stamp.

A symbol is the number that a pose has in the problem. Measurements ask for the pose at their own stamp,
and poses are linked in the order of their stamps, whatever order they were asked for in.
"""

from __future__ import annotations

from bisect import bisect_left, insort

from mapstream.streams.errors import EstimationError


class PoseSymbols:
    """Symbols of the poses of any number of missions, in both directions."""

    def __init__(self) -> None:
        self._symbols: dict[tuple[str, int], int] = {}
        self._places: list[tuple[str, int]] = []  # by symbol
        self._stamps: dict[str, list[int]] = {}  # by mission, in order

    def __len__(self) -> int:
        return len(self._places)

    def pose_at(self, mission_id: str, stamp_ns: int) -> int:
        """Return the symbol of the pose at a stamp; the first to ask makes it."""
        place = (mission_id, stamp_ns)
        if place not in self._symbols:
            self._symbols[place] = len(self._places)
            self._places.append(place)
            insort(self._stamps.setdefault(mission_id, []), stamp_ns)
        return self._symbols[place]

    def known(self, mission_id: str, stamp_ns: int) -> int:
        """Return the symbol of a pose that exists.

        Raises:
            EstimationError: If nobody asked for a pose at this stamp.
        """
        try:
            return self._symbols[mission_id, stamp_ns]
        except KeyError:
            raise EstimationError(f"mission {mission_id} has no pose at {stamp_ns} ns") from None

    def place_of(self, symbol: int) -> tuple[str, int]:
        """Return the mission and the stamp [ns] of a symbol."""
        return self._places[symbol]

    def previous(self, mission_id: str, stamp_ns: int) -> int | None:
        """Return the symbol of the newest pose before a stamp, or None if there is none."""
        stamps = self._stamps.get(mission_id, [])
        at = bisect_left(stamps, stamp_ns) - 1
        return self._symbols[mission_id, stamps[at]] if at >= 0 else None

    def next(self, mission_id: str, stamp_ns: int) -> int | None:
        """Return the symbol of the oldest pose after a stamp, or None if there is none."""
        stamps = self._stamps.get(mission_id, [])
        at = bisect_left(stamps, stamp_ns + 1)
        return self._symbols[mission_id, stamps[at]] if at < len(stamps) else None
