"""Names of the variables in the problem: gtsam's keys, from rows of a map's tables.

Poses of vertices have the rows themselves as keys, from 0; the rest carry a letter in the highest byte.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import gtsam
import numpy as np

from mapstream.streams.arrays import IntArray

Variable = Literal[
    "pose",
    "velocity",
    "bias",
    "landmark",
    "frame",
    "extrinsics",
    "camera",
    "intrinsics",
    "time_offset",
]

_LETTERS: dict[Variable, str] = {
    "velocity": "v",  # (3,) of the base, in the map frame [m/s]
    "bias": "b",  # gtsam.imuBias.ConstantBias, in the IMU's frame
    "landmark": "l",  # Point3, Point2, Pose3 or OrientedPlane3, in the map frame
    "frame": "f",  # Pose3, T_map_frame
    "extrinsics": "e",  # Pose3, T_base_sensor; rows count the sensors of all missions
    "camera": "c",  # Pose3, T_base_sensor of a camera; rows count the cameras of all missions
    "intrinsics": "k",  # (P,) fx fy cx cy [xi] distortion of a camera
    "time_offset": "t",  # (1,) by which a camera's images are later than their stamps [s]
}
_VARIABLES: dict[str, Variable] = {letter: variable for variable, letter in _LETTERS.items()}
_INDEX_BITS = 56  # the letter lies above them


def key_of(variable: Variable, row: int) -> int:
    """Return the key of a variable of a row: of `vertices`, `landmarks`, `frames` or sensors."""
    if variable == "pose":
        return row
    return int(gtsam.symbol(_LETTERS[variable], row))


def variable_of(key: int) -> tuple[Variable, int]:
    """Return the kind of variable and the row behind a key.

    Raises:
        KeyError: If no variable has such a key.
    """
    letter, index = key >> _INDEX_BITS, key & ((1 << _INDEX_BITS) - 1)
    if letter == 0:
        return "pose", index
    return _VARIABLES[chr(letter)], index


def rows_by_variable(keys: Iterable[int]) -> dict[Variable, IntArray]:
    """Return the rows (N,) behind keys, in order, by kind of variable; kinds without a key are absent.

    Raises:
        KeyError: If no variable has such a key.
    """
    each = np.sort(np.fromiter(keys, dtype=np.int64))
    letters, rows = each >> _INDEX_BITS, each & ((1 << _INDEX_BITS) - 1)
    variables: dict[Variable, IntArray] = {}
    for letter in np.unique(letters).tolist():
        variables[_VARIABLES[chr(letter)] if letter else "pose"] = rows[letters == letter]
    return variables
