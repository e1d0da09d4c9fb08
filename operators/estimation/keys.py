"""Names of the variables in the problem: gtsam's keys, from rows of a map's tables.

Poses of vertices have the rows themselves as keys, from 0; the rest carry a letter in the highest byte.
"""

from __future__ import annotations

from typing import Literal

import gtsam

Variable = Literal["pose", "velocity", "bias", "landmark", "frame", "extrinsics"]

_LETTERS: dict[Variable, str] = {
    "velocity": "v",  # (3,) of the base, in the map frame [m/s]
    "bias": "b",  # gtsam.imuBias.ConstantBias, in the IMU's frame
    "landmark": "l",  # Point3, Pose3 or OrientedPlane3, in the map frame
    "frame": "f",  # Pose3, T_map_frame
    "extrinsics": "e",  # Pose3, T_base_sensor; rows count the sensors that were asked for
}
_VARIABLES: dict[str, Variable] = {letter: variable for variable, letter in _LETTERS.items()}


def key_of(variable: Variable, row: int) -> int:
    """Return the key of a variable of a row: of `vertices`, `landmarks` or `frames`."""
    if variable == "pose":
        return row
    return int(gtsam.symbol(_LETTERS[variable], row))


def variable_of(key: int) -> tuple[Variable, int]:
    """Return the kind of variable and the row behind a key.

    Raises:
        KeyError: If no variable has such a key.
    """
    letter, index = gtsam.Symbol(key).chr(), gtsam.Symbol(key).index()
    if letter == 0:
        return "pose", int(index)
    return _VARIABLES[chr(letter)], int(index)
