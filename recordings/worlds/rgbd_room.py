"""The room of the world W-RGBD: walls with pictures, a cupboard, and a table with six things on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mapstream.recordings.worlds.paint import Painter
from mapstream.recordings.worlds.room_paint import ceiling, floor, one_color, wall
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism, shell
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp

_SIZE_M = (5.2, 4.4, 2.6)
TABLE_HEIGHT_M = 0.75
_TABLE_M, _BOARD_M, _LEG_M = (1.4, 0.8), 0.04, 0.06


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """What stands where, around the origin; the floor is at z = 0, the table in the middle."""

    surfaces: tuple[Surface, ...]
    things: tuple[Thing, ...]

    def without(self, names: Sequence[str]) -> Room:
        """Return the room after somebody carried away what has one of these names."""
        return Room(
            tuple(surface for surface in self.surfaces if surface.name not in names),
            tuple(thing for thing in self.things if thing.name not in names),
        )


def rgbd_room(seed: int, *, texel_m: float) -> Room:
    """Return a room whose pictures depend on the seed, and where the things lie on the table."""
    rng = np.random.default_rng(seed)
    painter = Painter(rng, texel_m, is_colored=True)
    things = _things(rng)
    surfaces = [
        *shell(_SIZE_M, *(partial(paint, painter) for paint in (wall, floor, ceiling))),
        *_furniture(painter),
    ]
    fine = Painter(rng, texel_m / 2, is_colored=True)  # seen from near
    for thing in things:
        paint = one_color(fine, rng.uniform(60, 220), 60, 1500)
        surfaces += prism(thing.name, thing.T_world_thing, thing.outline_m, thing.height_m, paint)
    return Room(tuple(surfaces), things)


def _furniture(painter: Painter) -> list[Surface]:
    """Return the table, a cupboard and two crates."""
    wood = one_color(painter, 150, 25, 80)
    length, width = _TABLE_M
    legs_m = TABLE_HEIGHT_M - _BOARD_M
    surfaces = prism("table", _at(0, 0, legs_m), box_outline(length, width), _BOARD_M, wood)
    x, y = length / 2 - _LEG_M, width / 2 - _LEG_M
    for corner in ((x, y), (-x, y), (-x, -y), (x, -y)):
        surfaces += prism("table", _at(*corner, 0), box_outline(_LEG_M, _LEG_M), legs_m, wood)
    dark = one_color(painter, 90, 20, 80)
    surfaces += prism("cupboard", _at(-2.1, 1.93, 0), box_outline(0.9, 0.5), 1.8, dark)
    surfaces += prism("crate", _at(2.2, -1.7, 0, 0.3), box_outline(0.45, 0.5), 0.55, dark)
    return [*surfaces, *prism("crate", _at(2.25, 1.75, 0), box_outline(0.5, 0.5), 0.9, dark)]


def _things(rng: np.random.Generator) -> tuple[Thing, ...]:
    kinds: list[tuple[str, FloatArray, float]] = [
        ("book", box_outline(0.24, 0.17), 0.05),
        ("cereal_box", box_outline(0.20, 0.07), 0.30),
        ("milk_carton", box_outline(0.10, 0.10), 0.22),
        ("tin", _regular(8, 0.06), 0.14),
        ("block", _regular(3, 0.10), 0.10),
        ("shoe_box", box_outline(0.30, 0.19), 0.12),
    ]
    places = [(x, y) for y in (-0.2, 0.2) for x in (-0.45, 0.0, 0.45)]
    order = rng.permutation(len(places))
    things = []
    for (name, outline, height), place in zip(kinds, order, strict=True):
        x, y = np.array(places[place]) + rng.uniform(-0.04, 0.04, 2)
        spot = _at(x, y, TABLE_HEIGHT_M, rng.uniform(0, 2 * np.pi))
        thing = Thing(name=name, label=name, T_world_thing=spot, outline_m=outline, height_m=height)
        things.append(thing)
    return tuple(things)


def _regular(num_corners: int, radius_m: float) -> FloatArray:
    angles = 2 * np.pi * np.arange(num_corners) / num_corners
    return radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _at(x: float, y: float, z: float, turn_rad: float = 0.0) -> SE3:
    return SE3.from_rotation(so3_exp([0, 0, turn_rad]), [x, y, z])
