"""Things that stand in a world, each with a name of its own and a class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thing:
    """An upright prism; its frame stands on the ground of it, z upwards."""

    name: str  # that of all its surfaces, and of nothing else
    label: str  # its class
    T_world_thing: SE3
    outline_m: FloatArray  # (N, 2) convex, counter-clockwise from above
    height_m: float

    @property
    def extent_m(self) -> FloatArray:
        """Return the sides (3,) of the box around it."""
        return np.array([*np.ptp(self.outline_m, axis=0), self.height_m])

    @property
    def T_world_box(self) -> SE3:
        """Return the place of the middle of the box around it."""
        low, high = self.outline_m.min(axis=0), self.outline_m.max(axis=0)
        middle = [*((low + high) / 2), self.height_m / 2]
        return self.T_world_thing @ SE3.from_rotation(np.eye(3), middle)
