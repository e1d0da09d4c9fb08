"""The building of the world W-MR: six rooms along a corridor, painted, furnished, and full of things."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise

import cv2
import numpy as np

from mapstream.recordings.worlds.furniture import Furnisher
from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.room_paint import ceiling, floor, wall
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism, shell
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.geometry import SE3

HEIGHT_M = 2.8
CORRIDOR_M = 1.1  # half of its width
LENGTH_M, DEPTH_M = 16.2, 11.4  # along the corridor, and across
_WALL_M = 0.12
_DOOR_M = 1.3
_DOOR_REACH_M = 0.9  # of a door's middle from that of its room
_ROOMS = ((-5.4, -1), (0.0, -1), (5.4, -1), (5.4, 1), (0.0, 1), (-5.4, 1))  # x, side; all round


@dataclass(frozen=True, slots=True)
class Room:
    """A room on one side of the corridor, which runs along x."""

    number: int
    low_m: tuple[float, float]  # corners, within the walls
    high_m: tuple[float, float]
    side: int  # 1: beyond the corridor's left wall, -1: the right one
    door_m: float  # x of the middle of its door

    @property
    def middle_m(self) -> tuple[float, float]:
        (x0, y0), (x1, y1) = self.low_m, self.high_m
        return (x0 + x1) / 2, (y0 + y1) / 2


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """What stands where, around the middle of the corridor's floor."""

    rooms: tuple[Room, ...]
    surfaces: tuple[Surface, ...]  # coloured
    things: tuple[Thing, ...]

    def in_grey(self) -> tuple[Surface, ...]:
        """Return the surfaces as a camera without colours sees them."""
        return tuple(replace(each, picture=_in_grey(each.picture)) for each in self.surfaces)


def _in_grey(picture: Picture) -> Picture:
    return cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)


@lru_cache(maxsize=1)  # painting takes seconds
def building(seed: int, *, texel_m: float) -> Building:
    """Return a building: pictures, doors, furniture and things depend on the seed, pictures on the texel too."""
    rng, paint_rng = map(np.random.default_rng, np.random.SeedSequence((seed, 12)).spawn(2))
    rooms = tuple(_room(number, rng) for number in range(len(_ROOMS)))
    painter = Painter(paint_rng, texel_m, is_colored=True)
    coarse = Painter(paint_rng, 2 * texel_m, is_colored=True)  # nobody comes near
    outside = shell(
        (LENGTH_M, DEPTH_M, HEIGHT_M),
        partial(wall, painter),
        partial(floor, coarse),
        partial(ceiling, coarse),
    )
    furnisher = Furnisher(painter, rng)
    for room in rooms:
        furnisher.furnish_room(room.low_m, room.high_m, (room.door_m, room.side))
    furnisher.furnish_corridor(
        LENGTH_M / 2, CORRIDOR_M, [(room.door_m, room.side) for room in rooms], _DOOR_M
    )
    inside = [side for each in _walls(rooms, painter) for side in each]
    return Building(rooms, (*outside, *inside, *furnisher.surfaces), tuple(furnisher.things))


def _room(number: int, rng: np.random.Generator) -> Room:
    x, side = _ROOMS[number]
    spans = sorted((side * (CORRIDOR_M + _WALL_M), side * DEPTH_M / 2))
    half = (LENGTH_M / 3 - _WALL_M) / 2
    door = x + rng.uniform(-_DOOR_REACH_M, _DOOR_REACH_M)
    return Room(number, (x - half, spans[0]), (x + half, spans[1]), side, float(door))


def _walls(rooms: tuple[Room, ...], painter: Painter) -> Iterator[list[Surface]]:
    """Yield the walls between the rooms and the corridor, with gaps for doors, and between rooms."""
    ends = LENGTH_M / 2
    for side in (-1, 1):
        doors = sorted(room.door_m for room in rooms if room.side == side)
        starts = [-ends, *(door + _DOOR_M / 2 for door in doors)]
        stops = [*(door - _DOOR_M / 2 for door in doors), ends]
        y = side * (CORRIDOR_M + _WALL_M / 2)
        for start, stop in zip(starts, stops, strict=True):
            yield _upright(painter, ((start + stop) / 2, y), (stop - start, _WALL_M))
        depth = DEPTH_M / 2 - CORRIDOR_M - _WALL_M
        for left, right in pairwise(sorted({room.low_m[0] for room in rooms})):
            x = (left + right) / 2 + LENGTH_M / 6 - _WALL_M / 2
            middle = (x, side * (DEPTH_M / 2 - depth / 2))
            yield _upright(painter, middle, (_WALL_M, depth))


def _upright(
    painter: Painter, middle_m: tuple[float, float], size_m: tuple[float, float]
) -> list[Surface]:
    place = SE3.from_rotation(np.eye(3), [*middle_m, 0.0])
    return prism("wall", place, box_outline(*size_m), HEIGHT_M, partial(wall, painter))
