"""What rooms that people live in are painted with."""

from __future__ import annotations

from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.surfaces import Paint


def wall(painter: Painter, size_m: tuple[float, float]) -> Picture:
    """Paint plaster with pictures on it."""
    picture = painter.blank(size_m, painter.color(painter.rng.uniform(160, 205), 18))
    painter.plaster(picture, 12)
    painter.leaves(picture, round(25 * size_m[0] * size_m[1]), (0.015, 0.2))
    painter.posters(picture, round(8 * size_m[0]), (0.3, 0.9))
    return picture


def floor(painter: Painter, size_m: tuple[float, float]) -> Picture:
    """Paint tiles."""
    picture = painter.blank(size_m, painter.color(105, 25))
    painter.tiles(picture, 0.35, 14, -40)
    painter.plaster(picture, 12)
    painter.leaves(picture, round(30 * size_m[0] * size_m[1]), (0.015, 0.25))
    return picture


def ceiling(painter: Painter, size_m: tuple[float, float]) -> Picture:
    """Paint it white, with lamps."""
    picture = painter.blank(size_m, painter.color(215, 5))
    painter.plaster(picture, 5)
    painter.lamps(picture, 2.2, (0.9, 0.2))
    return picture


def one_color(painter: Painter, level: float, spread: float, leaves_per_m2: float) -> Paint:
    """Return the paint of one thing: all its sides have one colour, and leaves on it."""
    color = painter.color(level, spread)

    def paint(size_m: tuple[float, float]) -> Picture:
        picture = painter.blank(size_m, color)
        painter.plaster(picture, 12)
        count = round(leaves_per_m2 * size_m[0] * size_m[1])
        painter.leaves(picture, count + 6, (0.008, 0.12))
        return picture

    return paint
