"""Options by which verbs choose missions and places."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3

MissionOption = Annotated[
    str | None, typer.Option("--mission", help="First digits of an id, or a name; all without.")
]
MissionArgument = Annotated[str, typer.Argument(help="First digits of its id, or its name.")]


def pose_of(text: str) -> SE3:
    """Return the pose that is written as x,y,z or x,y,z,qx,qy,qz,qw.

    Raises:
        ConfigError: If it is written in another way.
    """
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) == 3:
        numbers = np.append(numbers, [0, 0, 0, 1])
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not np.any(numbers[3:]):
        raise ConfigError(f"expected x,y,z or x,y,z,qx,qy,qz,qw, found {text!r}")
    return SE3.from_quat_xyzw(numbers[3:], numbers[:3])


def point_of(text: str) -> FloatArray:
    """Return the point (3,) that is written as x,y,z [m].

    Raises:
        ConfigError: If it is written in another way.
    """
    try:
        point = np.array([float(word) for word in text.split(",")])
    except ValueError:
        point = np.empty(0)
    if len(point) != 3 or not np.isfinite(point).all():
        raise ConfigError(f"expected x,y,z, found {text!r}")
    return point
