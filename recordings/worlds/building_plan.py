"""The plan of a building of W-MR: three rooms on either side of a corridor, and a door to each."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

WALL_M = 0.12
_DOOR_REACH_M = 0.9  # of a door's middle from that of its room
_AROUND = ((0, -1), (1, -1), (2, -1), (2, 1), (1, 1), (0, 1))  # column, side of each room
_COLUMNS = 3
# Smaller rooms and doors would leave no way between the furniture, see `building_tour`.
_LENGTHS_M, _DEPTHS_M = (17.0, 21.0), (4.3, 5.8)  # along the corridor; of a room
_CORRIDORS_M, _DOORS_M = (0.95, 1.5), (1.1, 1.7)
_WEIGHTS = (0.92, 1.1)  # of the rooms of one side


@dataclass(frozen=True, slots=True)
class Room:
    """A room on one side of the corridor, which runs along x."""

    number: int
    low_m: tuple[float, float]  # corners, within the walls
    high_m: tuple[float, float]
    side: int  # 1: beyond the corridor's left wall, -1: the right one
    door_m: float  # x of the middle of its door
    door_width_m: float

    @property
    def middle_m(self) -> tuple[float, float]:
        (x0, y0), (x1, y1) = self.low_m, self.high_m
        return (x0 + x1) / 2, (y0 + y1) / 2


@dataclass(frozen=True, slots=True)
class Plan:
    """Where the walls are, around the middle of the corridor."""

    length_m: float  # along the corridor
    depth_m: float  # across
    corridor_m: float  # half of its width
    rooms: tuple[Room, ...]  # all round

    def of_side(self, side: int) -> list[Room]:
        """Return the rooms of one side, along x."""
        return sorted((room for room in self.rooms if room.side == side), key=lambda r: r.low_m)


@dataclass(frozen=True, slots=True)
class _Measures:
    """How large all is."""

    length_m: float
    depth_m: float
    corridor_m: float
    shares: dict[int, list[float]]  # of the length that rooms take, by side
    doors_m: list[float]  # widths


_EQUAL = _Measures(16.2, 11.4, 1.1, {side: [1 / 3] * 3 for side in (-1, 1)}, [1.3] * 6)


def building_plan(seed: int, door_rng: np.random.Generator, rng: np.random.Generator) -> Plan:
    """Return the plan of a building: walls and doors of two buildings differ.

    Args:
        seed: Of the building; the rooms of building 0 are equal, and wide doors lead to them.
        door_rng: Says where in its wall each door is.
        rng: Says how large all is, but in building 0.
    """
    measures = _drawn(rng) if seed else _EQUAL
    rooms = tuple(_room(number, measures, door_rng) for number in range(len(_AROUND)))
    return Plan(measures.length_m, measures.depth_m, measures.corridor_m, rooms)


def _drawn(rng: np.random.Generator) -> _Measures:
    length, deep, corridor = (rng.uniform(*span) for span in (_LENGTHS_M, _DEPTHS_M, _CORRIDORS_M))
    weights = {side: rng.uniform(*_WEIGHTS, _COLUMNS) for side in (-1, 1)}
    shares = {side: (each / each.sum()).tolist() for side, each in weights.items()}
    doors = rng.uniform(*_DOORS_M, len(_AROUND)).tolist()
    return _Measures(length, 2 * (deep + corridor + WALL_M), corridor, shares, doors)


def _room(number: int, measures: _Measures, rng: np.random.Generator) -> Room:
    column, side = _AROUND[number]
    shares, length = measures.shares[side], measures.length_m
    starts = list(accumulate(shares, initial=-0.5))
    low, high = starts[column] * length + WALL_M / 2, starts[column + 1] * length - WALL_M / 2
    near, far = sorted((side * (measures.corridor_m + WALL_M), side * measures.depth_m / 2))
    door = (low + high) / 2 + rng.uniform(-_DOOR_REACH_M, _DOOR_REACH_M)
    return Room(number, (low, near), (high, far), side, float(door), measures.doors_m[number])
