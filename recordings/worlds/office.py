"""A floor of offices round a ring of corridors: walls, doors, furniture, as upright boxes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.recordings.worlds.mesh import Mesh, box, join
from mapstream.streams.arrays import BoolArray, FloatArray, frozen
from mapstream.streams.geometry import SE3, so3_exp

# no multiples of the cells of a grid, as in a real building
CORRIDOR_M = 2.03  # width
ROOM_M = 4.51  # depth of the outer rooms
CORE_M = 4.04  # depth of the rooms within the ring
DEPTH_M = 2 * ROOM_M + 2 * CORRIDOR_M + CORE_M
MIN_WIDTH_M = 14.0
DOOR_M = 1.0
_OUTER_M, _INNER_M = 0.25, 0.12  # thickness of walls
_HEIGHT_M = 2.5
_LANE_M = 0.7  # from the middle of a way that stays clear
_KINDS = ((1.6, 0.8), (0.9, 0.45), (0.5, 0.5), (1.2, 0.6), (0.3, 0.3))  # desks, cupboards, chairs
_SPAN = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Room:
    """A room between two walls along y, with its door to a corridor along x."""

    x_m: _SPAN
    y_m: _SPAN
    door_m: float  # x of the door's middle
    door_side: int  # 1: in the upper wall, -1: in the lower one

    @property
    def wall_m(self) -> float:
        """Return y of the wall with the door."""
        return self.y_m[1] if self.door_side > 0 else self.y_m[0]

    @property
    def corridor_m(self) -> float:
        """Return y of the middle of the corridor."""
        return self.wall_m + self.door_side * CORRIDOR_M / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Office:
    """What stands on a floor; amid the southern corridor is the origin, along it lies x."""

    boxes: FloatArray  # (N, 5) middle x, y [m], turn [rad], length, width [m]
    rooms: tuple[Room, ...]
    corner: FloatArray  # (2,) the lower left one, inside [m]
    width_m: float

    def __post_init__(self) -> None:
        frozen(self, "boxes", np.float64, (None, 5))
        frozen(self, "corner", np.float64, (2,))

    def mesh(self) -> Mesh:
        """Return the ground, and all that stands on it, to the ceiling."""
        size = [self.width_m + 2 * _OUTER_M, DEPTH_M + 2 * _OUTER_M, 0.1]
        middle = self.corner + np.array([self.width_m, DEPTH_M]) / 2
        ground = box(SE3.from_rotation(np.eye(3), [*middle, -0.05]), size, 0.3)
        things = [
            box(
                SE3.from_rotation(so3_exp([0, 0, turn]), [x, y, _HEIGHT_M / 2]),
                [length, width, _HEIGHT_M],
                0.5,
            )
            for x, y, turn, length, width in self.boxes
        ]
        return join([ground, *things])

    def is_solid(self, points: FloatArray) -> BoolArray:
        """Return whether points (..., 2) [m] lie within a wall or a thing."""
        solid = np.zeros(points.shape[:-1], bool)
        for x, y, turn, length, width in self.boxes:
            offset = points - [x, y]
            along = offset @ [np.cos(turn), np.sin(turn)]
            across = offset @ [-np.sin(turn), np.cos(turn)]
            solid |= (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)
        return solid

    def is_inside(self, points: FloatArray) -> BoolArray:
        """Return whether points (..., 2) [m] lie within the outer walls."""
        x, y = np.moveaxis(points - self.corner, -1, 0)
        inside: BoolArray = (x > 0) & (x < self.width_m) & (y > 0) & (y < DEPTH_M)
        return inside


def office(
    width_m: float, rng: np.random.Generator, *, has_rooms: bool = True, furnished: bool = True
) -> Office:
    """Return a floor with rooms on both sides and within the ring; without rooms the walls are smooth."""
    rooms = tuple(_rooms(width_m, rng)) if has_rooms else ()  # from the corner, for now
    walls = [*_outer_walls(width_m), *_corridor_walls(width_m, rooms), *_partitions(rooms)]
    things = [*_furniture(rooms, rng), *_cupboards(width_m, rooms, rng)] if furnished else []
    corner = np.array([-width_m / 2, -ROOM_M - CORRIDOR_M / 2])
    boxes = np.array([*walls, *things])
    boxes[:, :2] += corner
    moved = tuple(_moved(room, *corner.tolist()) for room in rooms)
    return Office(boxes=boxes, rooms=moved, corner=corner, width_m=width_m)


def _moved(room: Room, x_m: float, y_m: float) -> Room:
    return Room(
        (room.x_m[0] + x_m, room.x_m[1] + x_m),
        (room.y_m[0] + y_m, room.y_m[1] + y_m),
        room.door_m + x_m,
        room.door_side,
    )


def _rooms(width_m: float, rng: np.random.Generator) -> Iterator[Room]:
    south = ROOM_M + CORRIDOR_M
    north = south + CORE_M + CORRIDOR_M
    inside = (CORRIDOR_M, width_m - CORRIDOR_M)
    for x_m, y_m, side in (
        ((0.0, width_m), (0.0, ROOM_M), 1),
        (inside, (south, south + CORE_M), 0),
        ((0.0, width_m), (north, DEPTH_M), -1),
    ):
        for span in _parts(x_m, rng):
            door = rng.uniform(span[0] + 1.2, span[1] - 1.2)
            yield Room(span, y_m, door, side or int(rng.choice([-1, 1])))


def _parts(span: _SPAN, rng: np.random.Generator) -> list[_SPAN]:
    """Return a span cut into parts of about five metres."""
    num = max(1, round((span[1] - span[0]) / 5.0))
    cuts = np.linspace(*span, num + 1)
    cuts[1:-1] += rng.uniform(-0.7, 0.7, num - 1)
    return list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))


def _wall(x_m: _SPAN, y_m: _SPAN) -> FloatArray:
    """Return the box of a wall along x or y."""
    return np.array([sum(x_m) / 2, sum(y_m) / 2, 0.0, x_m[1] - x_m[0], y_m[1] - y_m[0]])


def _outer_walls(width_m: float) -> Iterator[FloatArray]:
    t = _OUTER_M
    for y in (-t, DEPTH_M):
        yield _wall((-t, width_m + t), (y, y + t))
    for x in (-t, width_m):
        yield _wall((x, x + t), (0.0, DEPTH_M))


def _corridor_walls(width_m: float, rooms: tuple[Room, ...]) -> Iterator[FloatArray]:
    """Yield the walls on both sides of the corridors; walls stand on their rooms' side of the line."""
    south = ROOM_M + CORRIDOR_M
    north, t = south + CORE_M, _INNER_M
    for y, side, x_m in (
        (ROOM_M, -1, (0.0, width_m)),
        (south, 1, (CORRIDOR_M, width_m - CORRIDOR_M)),
        (north, -1, (CORRIDOR_M, width_m - CORRIDOR_M)),
        (north + CORRIDOR_M, 1, (0.0, width_m)),
    ):
        y_m = (y, y + t) if side > 0 else (y - t, y)
        doors = sorted(room.door_m for room in rooms if room.wall_m == y)
        starts = [x_m[0], *(door + DOOR_M / 2 for door in doors)]
        ends = [*(door - DOOR_M / 2 for door in doors), x_m[1]]
        for start, end in zip(starts, ends, strict=True):
            yield _wall((start, end), y_m)
    for x in (CORRIDOR_M, width_m - CORRIDOR_M - t):
        yield _wall((x, x + t), (south, north))


def _partitions(rooms: tuple[Room, ...]) -> Iterator[FloatArray]:
    """Yield the walls between neighbours."""
    for left, right in pairwise(rooms):
        if left.y_m == right.y_m:
            x = left.x_m[1]
            yield _wall((x - _INNER_M / 2, x + _INNER_M / 2), left.y_m)


def _furniture(rooms: tuple[Room, ...], rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield things in the rooms; the way from the door to the middle stays clear."""
    for room in rooms:
        (x0, x1), (y0, y1) = room.x_m, room.y_m
        middle = (y0 + y1) / 2
        lane = sorted((middle - room.door_side * _LANE_M, room.wall_m))
        for _ in range(round((x1 - x0) * (y1 - y0) / 3.5)):
            length, width = _KINDS[rng.integers(len(_KINDS))]
            turn = rng.normal(0.0, 0.06) + rng.choice([0.0, np.pi / 2])
            c, s = abs(np.cos(turn)), abs(np.sin(turn))
            reach_x, reach_y = (c * length + s * width) / 2, (s * length + c * width) / 2
            x = rng.uniform(x0 + reach_x, x1 - reach_x)
            low, high = y0 + reach_y, y1 - reach_y
            y = rng.choice([low, high, rng.uniform(low, high)])
            is_aside = abs(x - room.door_m) > _LANE_M + reach_x
            if is_aside or not lane[0] - reach_y < y < lane[1] + reach_y:
                yield np.array([x, y, turn, length, width])


def _cupboards(
    width_m: float, rooms: tuple[Room, ...], rng: np.random.Generator
) -> Iterator[FloatArray]:
    """Yield what stands along the corridors, away from the doors."""
    depth = 0.35
    for y, side in (
        (ROOM_M, 1),
        (ROOM_M + CORRIDOR_M, -1),
        (DEPTH_M - ROOM_M - CORRIDOR_M, 1),
        (DEPTH_M - ROOM_M, -1),
    ):
        for x in np.arange(3.5, width_m - 3.5, 2.0) + rng.uniform(-0.5, 0.5):
            length = rng.uniform(0.5, 1.1)
            is_clear = all(abs(room.door_m - x) > 1.3 for room in rooms if room.wall_m == y)
            if is_clear and rng.random() < 0.4:
                yield np.array([x, y + side * depth / 2, 0.0, length, depth])
