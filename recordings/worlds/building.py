"""The building of the world W-MR: six rooms along a corridor, painted, furnished, and full of things."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise

import cv2
import numpy as np

from mapstream.recordings.worlds.building_plan import WALL_M, Plan, Room, building_plan
from mapstream.recordings.worlds.furniture import Furnisher
from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.room_paint import ceiling, floor, wall
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism, shell
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.geometry import SE3

HEIGHT_M = 2.8


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """What stands where, around the middle of the corridor's floor."""

    plan: Plan
    surfaces: tuple[Surface, ...]  # coloured
    things: tuple[Thing, ...]

    @property
    def rooms(self) -> tuple[Room, ...]:
        return self.plan.rooms

    def in_grey(self) -> tuple[Surface, ...]:
        """Return the surfaces as a camera without colours sees them."""
        return tuple(replace(each, picture=_in_grey(each.picture)) for each in self.surfaces)


def _in_grey(picture: Picture) -> Picture:
    return cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)


@lru_cache(maxsize=1)  # painting takes seconds
def building(seed: int, *, texel_m: float) -> Building:
    """Return a building: walls, pictures, furniture and things depend on the seed, pictures on the texel too."""
    seeds = np.random.SeedSequence((seed, 12)).spawn(3)
    rng, paint_rng, plan_rng = map(np.random.default_rng, seeds)
    plan = building_plan(seed, rng, plan_rng)
    painter = Painter(paint_rng, texel_m, is_colored=True)
    coarse = Painter(paint_rng, 2 * texel_m, is_colored=True)  # nobody comes near
    outside = shell(
        (plan.length_m, plan.depth_m, HEIGHT_M),
        partial(wall, painter),
        partial(floor, coarse),
        partial(ceiling, coarse),
    )
    furnisher = Furnisher(painter, rng)
    for room in plan.rooms:
        furnisher.furnish_room(room.low_m, room.high_m, (room.door_m, room.side))
    furnisher.furnish_corridor(
        plan.length_m / 2,
        plan.corridor_m,
        [(room.door_m, room.side, room.door_width_m) for room in plan.rooms],
    )
    inside = [side for each in _walls(plan, painter) for side in each]
    return Building(plan, (*outside, *inside, *furnisher.surfaces), tuple(furnisher.things))


def _walls(plan: Plan, painter: Painter) -> Iterator[list[Surface]]:
    """Yield the walls between the rooms and the corridor, with gaps for doors, and between rooms."""
    ends = plan.length_m / 2
    for side in (-1, 1):
        rooms = plan.of_side(side)
        starts = [-ends, *(room.door_m + room.door_width_m / 2 for room in rooms)]
        stops = [*(room.door_m - room.door_width_m / 2 for room in rooms), ends]
        beside = side * (plan.corridor_m + WALL_M / 2)
        for start, stop in zip(starts, stops, strict=True):
            yield _upright(painter, ((start + stop) / 2, beside), (stop - start, WALL_M))
        for left, right in pairwise(rooms):
            x, y = (left.high_m[0] + right.low_m[0]) / 2, left.middle_m[1]
            yield _upright(painter, (x, y), (WALL_M, left.high_m[1] - left.low_m[1]))


def _upright(
    painter: Painter, middle_m: tuple[float, float], size_m: tuple[float, float]
) -> list[Surface]:
    place = SE3.from_rotation(np.eye(3), [*middle_m, 0.0])
    return prism("wall", place, box_outline(*size_m), HEIGHT_M, partial(wall, painter))
