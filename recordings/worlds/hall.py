"""The hall of the world W-VI: 20 x 15 x 4 m, with posters on its walls, pillars, crates and tags."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism, rectangle, shell
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp

LENGTH_M, WIDTH_M, HEIGHT_M = 20.0, 15.0, 4.0
_SIZE_M = (LENGTH_M, WIDTH_M, HEIGHT_M)
_NUM_CRATES = 22
_CLEARANCE_M = 0.9  # between the path and what stands beside it
_PILLARS = ((3.6, 0.0), (-3.6, 0.0), (0.0, 3.4), (0.0, -3.4), (7.6, 4.6), (-7.6, -4.6))
_PILLAR_M = 0.5
_TAG_CELLS = 8  # of the family 36h11, with its black border
_TAG_CELL_TEXELS = 16
_TAG_HEIGHT_M = 1.6
_TAG_GAP_M = 0.01  # between a tag and its wall


@dataclass(frozen=True, slots=True, eq=False)
class Tag:
    """An AprilTag of the family 36h11. Its frame has x to the right, y up and z towards who reads it."""

    id: int
    T_world_tag: SE3  # of its middle
    size_m: float  # of the black square


@dataclass(frozen=True, slots=True, eq=False)
class Hall:
    """What stands where, around the origin; the floor is at z = 0."""

    surfaces: tuple[Surface, ...]
    tags: tuple[Tag, ...]


def hall(
    seed: int, path: FloatArray, *, texel_m: float, num_tags: int = 0, tag_size_m: float = 0.5
) -> Hall:
    """Return a hall whose things stand beside a path (N, 2) [m]."""
    rng = np.random.default_rng(seed)
    painter = Painter(rng, texel_m, is_colored=False)
    surfaces = [
        *shell(_SIZE_M, *(partial(paint, painter) for paint in (_wall, _floor, _ceiling))),
        *_pillars(painter),
        *_crates(painter, path),
    ]
    tags = tuple(_tag(number, tag_size_m) for number in range(num_tags))
    return Hall((*surfaces, *map(_tag_surface, tags)), tags)


def _wall(painter: Painter, size_m: tuple[float, float]) -> Picture:
    picture = painter.blank(size_m, [painter.rng.uniform(135, 175)])
    painter.plaster(picture, 12)
    painter.leaves(picture, round(18 * size_m[0] * size_m[1]), (0.02, 0.4))
    painter.posters(picture, round(6 * size_m[0]), (0.5, 1.9))
    return picture


def _floor(painter: Painter, size_m: tuple[float, float]) -> Picture:
    picture = painter.blank(size_m, [110])
    painter.tiles(picture, 0.6, 12, -45)
    painter.plaster(picture, 12)
    painter.leaves(picture, round(25 * size_m[0] * size_m[1]), (0.03, 1.0))
    return picture


def _ceiling(painter: Painter, size_m: tuple[float, float]) -> Picture:
    picture = painter.blank(size_m, [185])
    painter.tiles(picture, 0.625, 8, -60)
    painter.plaster(picture, 6)
    painter.leaves(picture, round(6 * size_m[0] * size_m[1]), (0.03, 0.5))
    painter.lamps(picture, 2.5, (1.2, 0.25))
    return picture


def _side(painter: Painter, size_m: tuple[float, float]) -> Picture:
    picture = painter.blank(size_m, [painter.rng.uniform(80, 200)])
    painter.plaster(picture, 12)
    painter.leaves(picture, round(60 * size_m[0] * size_m[1]) + 10, (0.03, 0.5))
    return picture


def _pillars(painter: Painter) -> list[Surface]:
    side, outline = partial(_side, painter), box_outline(_PILLAR_M, _PILLAR_M)
    places = [SE3.from_rotation(np.eye(3), [x, y, 0]) for x, y in _PILLARS]
    return [s for place in places for s in prism("pillar", place, outline, HEIGHT_M, side)]


def _crates(painter: Painter, path: FloatArray) -> list[Surface]:
    """Return crates on the floor, off the path and off each other."""
    rng, surfaces = painter.rng, []
    taken = [(x, y, _PILLAR_M) for x, y in _PILLARS]
    while len(taken) < len(_PILLARS) + _NUM_CRATES:
        size = rng.uniform([0.5, 0.5, 0.5], [1.3, 1.3, 2.2])
        radius = float(np.hypot(*size[:2])) / 2
        reach = np.array([LENGTH_M, WIDTH_M]) / 2 - radius - 0.05
        place, turn = rng.uniform(-reach, reach), rng.uniform(0, np.pi)
        near = np.array([np.hypot(*(place - other[:2])) - other[2] for other in taken])
        clear = np.linalg.norm(path - place, axis=1).min() - radius
        if clear < _CLEARANCE_M or near.min() < radius + 0.05:
            continue
        taken.append((place[0], place[1], radius))
        T_world_crate = SE3.from_rotation(so3_exp([0, 0, turn]), [*place, 0])
        paint = partial(_side, painter)
        surfaces += prism("crate", T_world_crate, box_outline(*size[:2]), size[2], paint)
    return surfaces


def _tag(number: int, size_m: float) -> Tag:
    """Return a tag on a wall: the first four amid each, the next ones between."""
    walls = [  # a point amid the wall, and the way to the right when one looks at it
        ([0, WIDTH_M / 2 - _TAG_GAP_M], [1, 0], LENGTH_M),
        ([LENGTH_M / 2 - _TAG_GAP_M, 0], [0, -1], WIDTH_M),
        ([0, -WIDTH_M / 2 + _TAG_GAP_M], [-1, 0], LENGTH_M),
        ([-LENGTH_M / 2 + _TAG_GAP_M, 0], [0, 1], WIDTH_M),
    ]
    middle, right, length = walls[number % 4]
    lap = (number // 4) * (-1) ** (number // 4)
    place = np.array(middle) + lap * 0.15 * length * np.array(right)
    x, y = np.array([*right, 0.0]), np.array([0, 0, 1.0])
    R = np.stack([x, y, np.cross(x, y)], axis=1)
    return Tag(number, SE3.from_rotation(R, [*place, _TAG_HEIGHT_M]), size_m)


def _tag_surface(tag: Tag) -> Surface:
    """Return the paper that a tag is printed on, with a white margin."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    code = cv2.aruco.generateImageMarker(family, tag.id, _TAG_CELLS * _TAG_CELL_TEXELS)
    picture = np.pad(code, _TAG_CELL_TEXELS, constant_values=255).astype(np.uint8)
    side = tag.size_m * (_TAG_CELLS + 2) / _TAG_CELLS
    corner = tag.T_world_tag @ np.array([-side / 2, side / 2, 0])
    return rectangle(
        f"tag{tag.id}",
        corner,
        tag.T_world_tag.R[:, 0] * side,
        -tag.T_world_tag.R[:, 1] * side,
        lambda _: picture,
    )
