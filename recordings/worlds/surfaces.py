"""Painted plane surfaces: what cameras see of a synthetic world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.recordings.worlds.paint import Picture
from mapstream.streams.arrays import FloatArray, frozen
from mapstream.streams.geometry import SE3

_MIN_PYRAMID_PX = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """A convex polygon in a plane, seen from the side that `normal` points to.

    The polygon has coordinates (s, t) in metres: a point is `origin + s * right + t * down`, as of a
    picture that hangs on a wall. Its picture covers the polygon's bounding box from (0, 0) on.
    """

    name: str  # of the thing that it belongs to
    origin: FloatArray  # (3,) [m] the picture's upper left corner
    right: FloatArray  # (3,) unit
    down: FloatArray  # (3,) unit, at a right angle to it
    polygon: FloatArray  # (E, 2) [m], clockwise as seen
    picture: Picture
    texel_m: float
    is_shell: bool = False  # nothing lies behind it

    def __post_init__(self) -> None:
        frozen(self, "polygon", np.float64, (None, 2))
        for name in ("origin", "right", "down"):
            frozen(self, name, np.float64, (3,))

    @property
    def normal(self) -> FloatArray:
        """Return the unit normal (3,), towards who sees the picture."""
        return np.cross(self.down, self.right)

    def points(self, st_m: FloatArray) -> FloatArray:
        """Return points (N, 3) in the world of plane coordinates (N, 2)."""
        points: FloatArray = self.origin + st_m @ np.stack([self.right, self.down])
        return points

    @property
    def size_m(self) -> FloatArray:
        """Return width and height (2,) of the polygon's bounding box."""
        size: FloatArray = self.polygon.max(axis=0)
        return size

    @property
    def is_rectangle(self) -> bool:
        return len(self.polygon) == 4 and bool(
            ((self.polygon == 0) | (self.polygon == self.size_m)).all()
        )

    def edges(self) -> FloatArray:
        """Return lines (E, 3) with `line @ [s, t, 1] >= 0` inside the polygon."""
        start, end = self.polygon, np.roll(self.polygon, -1, axis=0)
        inward = np.stack([start[:, 1] - end[:, 1], end[:, 0] - start[:, 0]], axis=1)
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        return np.concatenate([inward, -(inward * start).sum(axis=1, keepdims=True)], axis=1)


Paint = Callable[[tuple[float, float]], Picture]  # of a width and a height [m]


def rectangle(
    name: str,
    corner: npt.ArrayLike,
    right_m: npt.ArrayLike,
    down_m: npt.ArrayLike,
    paint: Paint,
    *,
    is_shell: bool = False,
) -> Surface:
    """Return a rectangle with its upper left corner and its two sides (3,) [m]."""
    right, down = np.asarray(right_m, dtype=np.float64), np.asarray(down_m, dtype=np.float64)
    width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    picture = paint((width, height))
    return Surface(
        name=name,
        origin=np.asarray(corner, dtype=np.float64),
        right=right / width,
        down=down / height,
        polygon=np.array([[0, 0], [width, 0], [width, height], [0, height]]),
        picture=picture,
        texel_m=width / picture.shape[1],
        is_shell=is_shell,
    )


def shell(
    size_m: tuple[float, float, float], wall: Paint, floor: Paint, ceiling: Paint
) -> list[Surface]:
    """Return a room's walls, floor and ceiling, seen from inside; the floor's middle is the origin."""
    x, y, z = size_m[0] / 2, size_m[1] / 2, size_m[2]
    down = [0, 0, -z]
    inside = partial(rectangle, is_shell=True)
    return [
        inside("wall_north", [-x, y, z], [2 * x, 0, 0], down, wall),
        inside("wall_east", [x, y, z], [0, -2 * y, 0], down, wall),
        inside("wall_south", [x, -y, z], [-2 * x, 0, 0], down, wall),
        inside("wall_west", [-x, -y, z], [0, 2 * y, 0], down, wall),
        inside("floor", [-x, y, 0], [2 * x, 0, 0], [0, -2 * y, 0], floor),
        inside("ceiling", [-x, -y, z], [2 * x, 0, 0], [0, 2 * y, 0], ceiling),
    ]


def prism(
    name: str, T_world_prism: SE3, outline_m: npt.ArrayLike, height_m: float, paint: Paint
) -> list[Surface]:
    """Return the sides and the top of an upright prism that stands on its frame's ground.

    Args:
        name: Of the thing.
        T_world_prism: Its place; z is upwards.
        outline_m: Shape (N, 2), convex, counter-clockwise from above.
        height_m: From the ground to the top.
        paint: Called for each surface.
    """
    outline = np.asarray(outline_m, dtype=np.float64)
    R, up = T_world_prism.R, T_world_prism.R[:, 2]
    ends = np.roll(outline, -1, axis=0)
    surfaces = []
    for start, end in zip(outline, ends, strict=True):
        corner = T_world_prism @ np.array([*start, height_m])
        side = R[:, :2] @ (end - start)
        surfaces.append(rectangle(name, corner, side, -height_m * up, paint))
    low, high = outline.min(axis=0), outline.max(axis=0)
    width, depth = (high - low).tolist()
    picture = paint((width, depth))
    top = Surface(
        name=name,
        origin=T_world_prism @ np.array([low[0], high[1], height_m]),
        right=R[:, 0],
        down=-R[:, 1],
        polygon=((outline - [low[0], high[1]]) * [1, -1])[::-1],
        picture=picture,
        texel_m=width / picture.shape[1],
    )
    return [*surfaces, top]


def box_outline(length_m: float, width_m: float) -> FloatArray:
    """Return the corners (4, 2) of a rectangle around the origin, for `prism`."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length_m / 2, width_m / 2]


def pyramid(picture: Picture) -> Sequence[Picture]:
    """Return a picture in full, half, a quarter ... of its size; halves are means of four texels."""
    levels = [picture]
    while min(levels[-1].shape[:2]) >= 2 * _MIN_PYRAMID_PX:
        height, width = levels[-1].shape[:2]
        even = levels[-1][: height // 2 * 2, : width // 2 * 2]
        half = cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        levels.append(half.astype(np.uint8, copy=False))
    return levels
