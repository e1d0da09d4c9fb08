"""People who walk round the table of W-RGBD while it is recorded, always across from the camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from mapstream.recordings.worlds.paint import Painter, Picture
from mapstream.recordings.worlds.renderer import Pinhole, Renderer, Rendering
from mapstream.recordings.worlds.surfaces import box_outline, prism
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, so3_exp

PERSON = -2
"""What the surface of the first person is in a rendering: none of the room's. Others count down from it."""

_REACH_M = (1.7, 1.4)  # of the way round the table
_SIZE_M = (0.45, 0.3, 1.7)  # wide, deep, high
_SWING_RAD, _PERIOD_S = 0.8, 7.0  # to and fro, seen from the table
_APART = 2.4  # of the period, from one person to the next: no two walk together


class People:
    """Walkers, as boxes of the size of a person, and what a camera sees of them."""

    def __init__(self, count: int, seed: int, start_ns: int, *, texel_m: float) -> None:
        self._start_ns = start_ns
        self._renderers = []
        for number in range(count):
            painter = Painter(np.random.default_rng((seed, 9, number)), texel_m, is_colored=True)
            outline = box_outline(_SIZE_M[0], _SIZE_M[1])
            paint = partial(_clothes, painter)
            surfaces = prism("person", SE3.identity(), outline, _SIZE_M[2], paint)
            self._renderers.append(Renderer(surfaces))

    def place(self, number: int, stamp_ns: int, T_world_camera: FloatArray) -> SE3:
        """Return T_world_person at a time, by where the camera (4, 4) is: beyond the table, in its view."""
        x, y = (T_world_camera[:2, 3] / _REACH_M).tolist()
        phase = 2 * np.pi * ((stamp_ns - self._start_ns) / 1e9 / _PERIOD_S + _APART * number)
        angle = np.arctan2(y, x) + np.pi + _SWING_RAD * np.sin(phase)
        spot = [_REACH_M[0] * np.cos(angle), _REACH_M[1] * np.sin(angle), 0.0]
        return SE3.from_rotation(so3_exp([0, 0, angle]), spot)

    def things(self, stamp_ns: int, T_world_camera: FloatArray) -> list[Thing]:
        """Return the people at a time, in the order of their surfaces."""
        return [
            Thing(
                name=f"person.{number}",
                label="person",
                T_world_thing=self.place(number, stamp_ns, T_world_camera),
                outline_m=box_outline(_SIZE_M[0], _SIZE_M[1]),
                height_m=_SIZE_M[2],
            )
            for number in range(len(self._renderers))
        ]

    def in_front_of(
        self, view: Rendering, lens: Pinhole, stamp_ns: int, T_world_camera: FloatArray
    ) -> Rendering:
        """Return what is seen of the room (a view of it) and of the people in it."""
        for number, renderer in enumerate(self._renderers):
            T_world_person = self.place(number, stamp_ns, T_world_camera)
            seen = renderer.rendering(lens, invert(T_world_person.matrix) @ T_world_camera)
            is_near = seen.inverse_depths > view.inverse_depths
            view = Rendering(
                np.where(is_near[..., None], seen.image, view.image),
                np.where(is_near, seen.inverse_depths, view.inverse_depths),
                np.where(is_near, PERSON - number, view.surfaces),
            )
        return view


def _clothes(painter: Painter, size_m: Sequence[float]) -> Picture:
    width_m, height_m = size_m
    picture = painter.blank((width_m, height_m), painter.color(painter.rng.uniform(60, 200), 60))
    painter.plaster(picture, 12)
    painter.leaves(picture, round(200 * width_m * height_m), (0.01, 0.1))
    return picture
