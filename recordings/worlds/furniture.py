"""Furniture beside the walls of rooms, a table amid each, and things of ten classes on it and on the floor."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.worlds.paint import Painter
from mapstream.recordings.worlds.room_paint import one_color
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp

_Corner = tuple[float, float]
TABLE_M, TABLE_HEIGHT_M = (1.3, 0.7), 0.74
_GAP_M = 0.06
_TRIES = 40
_CUPBOARDS = ((0.9, 1.7), (0.35, 0.45), (0.6, 2.1))  # lengths, depths, heights
_LOW_M = 1.3  # on what is lower things stand
_NUM_CUPBOARDS, _NUM_ON_FLOOR, _NUM_ON_TABLE = 5, 3, 3
_DOOR_LANE_M = 1.0
_CORRIDOR_STEP_M, _CORRIDOR_DEPTH_M = 1.9, 0.28
_EIGHT = 8


@dataclass(frozen=True, slots=True)
class _Kind:
    """A class of things."""

    label: str
    size_m: tuple[float, float, float]
    level: float  # how bright most of them are
    is_round: bool = False


_ON_FLOOR = (
    _Kind("chair", (0.46, 0.46, 0.9), 90),
    _Kind("bin", (0.34, 0.34, 0.5), 60, is_round=True),
    _Kind("plant", (0.4, 0.4, 1.1), 120, is_round=True),
    _Kind("backpack", (0.36, 0.24, 0.5), 150),
    _Kind("suitcase", (0.5, 0.26, 0.65), 200),
)
_ON_TABLES = (
    _Kind("monitor", (0.52, 0.14, 0.42), 45),
    _Kind("book", (0.25, 0.18, 0.08), 180),
    _Kind("bottle", (0.11, 0.11, 0.32), 110, is_round=True),
    _Kind("lamp", (0.18, 0.18, 0.45), 215, is_round=True),
    _Kind("printer", (0.42, 0.36, 0.26), 160),
)


class Furnisher:
    """Furnishes one building; nothing stands in the way from a door round a table."""

    def __init__(self, painter: Painter, rng: np.random.Generator) -> None:
        self.surfaces: list[Surface] = []
        self.things: list[Thing] = []
        self._painter, self._rng = painter, rng
        self._fine = Painter(painter.rng, painter.texel_m / 2, is_colored=True)  # seen from near
        self._counts: Counter[str] = Counter()
        self._taken: list[FloatArray] = []  # rectangles (4,) on the floor: low, high

    def furnish_room(self, low_m: _Corner, high_m: _Corner, door: tuple[float, int]) -> None:
        """Furnish the room between two corners, with a door at x in the wall on the corridor's side."""
        middle = (np.array(low_m) + high_m) / 2
        at, side = door
        wall = low_m[1] if side > 0 else high_m[1]
        lane = [[at - _DOOR_LANE_M, wall - 1.0], [at + _DOOR_LANE_M, wall + 1.0]]
        self._taken = [np.ravel(lane)]
        table = SE3.from_rotation(np.eye(3), [*middle, 0.0])
        self._block(table, TABLE_M, TABLE_HEIGHT_M)
        tops = [(table, TABLE_M, TABLE_HEIGHT_M)]
        for _ in range(_NUM_CUPBOARDS):
            length, depth, height = (self._rng.uniform(*span) for span in _CUPBOARDS)
            place = self._beside_wall(low_m, high_m, (length, depth))
            if place is not None:
                self._block(place, (length, depth), height)
                tops += [(place, (length, depth), height)] * (height < _LOW_M)
        for kind in self._rng.permutation(len(_ON_FLOOR))[:_NUM_ON_FLOOR]:
            sort = _ON_FLOOR[kind]
            place = self._beside_wall(low_m, high_m, sort.size_m[:2])
            if place is not None:
                self._thing(sort, place)
        self._fill_tops(tops)

    def furnish_corridor(
        self,
        half_length_m: float,
        half_width_m: float,
        doors: Sequence[tuple[float, int, float]],
    ) -> None:
        """Put shallow cupboards along a corridor around the origin, away from doors (x, side, width)."""
        for side in (-1, 1):
            for x in np.arange(-half_length_m + 1.2, half_length_m - 1.0, _CORRIDOR_STEP_M):
                length, height = self._rng.uniform(0.5, 1.0), self._rng.uniform(0.5, 2.2)
                if any(
                    at == side and abs(x - door) < (length + width) / 2 + _GAP_M
                    for door, at, width in doors
                ):
                    continue
                y = side * (half_width_m - _CORRIDOR_DEPTH_M / 2)
                place = SE3.from_rotation(np.eye(3), [x, y, 0.0])
                self._block(place, (length, _CORRIDOR_DEPTH_M), height)

    def _fill_tops(self, tops: Sequence[tuple[SE3, tuple[float, float], float]]) -> None:
        """Put things side by side on a table and on what is low."""
        for place, (length, depth), height in tops:
            num = min(_NUM_ON_TABLE, int(length / 0.45))
            for slot, kind in enumerate(self._rng.permutation(len(_ON_TABLES))[:num]):
                sort = _ON_TABLES[kind]
                if sort.size_m[1] > depth:
                    continue
                along = ((slot + 0.5) / num - 0.5) * (length - 0.1)
                turn = self._rng.choice([0.0, np.pi]) + self._rng.normal(0.0, 0.1)
                above = SE3.from_rotation(so3_exp([0, 0, turn]), [along, 0.0, height])
                self._thing(sort, place @ above)

    def _beside_wall(
        self, low_m: _Corner, high_m: _Corner, size_m: tuple[float, float]
    ) -> SE3 | None:
        """Return a free place for what is so long and so deep, its back to a wall; None if none is found."""
        low, high = np.array(low_m), np.array(high_m)
        length, depth = size_m
        for _ in range(_TRIES):
            axis, is_high = self._rng.integers(0, 2, 2)  # the wall runs along x or y
            half = np.array([length, depth])[:: 1 - 2 * int(axis)] / 2 + _GAP_M
            middle = self._rng.uniform(low + half, high - half)
            middle[1 - axis] = (high - half)[1 - axis] if is_high else (low + half)[1 - axis]
            spot = np.concatenate([middle - half, middle + half])
            if any((spot[:2] < t[2:]).all() and (t[:2] < spot[2:]).all() for t in self._taken):
                continue
            self._taken.append(spot)
            # what has a front shows it to the room
            turn = np.pi / 2 * axis + np.pi * (is_high == (axis == 0))
            return SE3.from_rotation(so3_exp([0, 0, turn]), [*middle, 0.0])
        return None

    def _block(self, place: SE3, size_m: tuple[float, float], height_m: float) -> None:
        paint = one_color(self._painter, self._rng.uniform(70, 180), 40, 80)
        self.surfaces += prism("furniture", place, box_outline(*size_m), height_m, paint)

    def _thing(self, kind: _Kind, place: SE3) -> None:
        scale = self._rng.uniform(0.9, 1.1)
        length, depth, height = (scale * np.array(kind.size_m)).tolist()
        outline = _round(length) if kind.is_round else box_outline(length, depth)
        name = f"{kind.label}.{self._counts[kind.label]}"
        self._counts[kind.label] += 1
        level = kind.level + self._rng.uniform(-25, 25)
        paint = one_color(self._fine, level, 60, 900)
        self.surfaces += prism(name, place, outline, height, paint)
        thing = Thing(
            name=name,
            label=kind.label,
            T_world_thing=place,
            outline_m=outline,
            height_m=height,
        )
        self.things.append(thing)


def _round(width_m: float) -> FloatArray:
    """Return a polygon with eight corners, so wide from side to side."""
    angles = (np.arange(_EIGHT) + 0.5) * 2 * np.pi / _EIGHT
    corners = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outline: FloatArray = corners * width_m / 2 / np.cos(np.pi / _EIGHT)
    return outline
