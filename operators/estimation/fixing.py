"""Variables that a solver must not move."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.estimation.factors.own_factor import OwnFactor, Residual
from mapstream.operators.estimation.keys import Variable, key_of, rows_by_variable, variable_of
from mapstream.operators.estimation.noise import Factor
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray

Fixable = Literal[
    "poses",
    "velocities",
    "biases",
    "landmarks",
    "frames",
    "extrinsics",
    "extrinsics_rotation",
    "extrinsics_translation",
    "intrinsics",
    "base_frames",
]
"""What can be held as a whole; `frames` are outer frames, `base_frames` those of missions, also where guessed."""

_VARIABLES: dict[Fixable, Variable] = {
    "poses": "pose",
    "velocities": "velocity",
    "biases": "bias",
    "landmarks": "landmark",
    "frames": "frame",
    "extrinsics": "extrinsics",
    "intrinsics": "intrinsics",
}


def fixed(key: int, pose: FloatArray) -> Factor:
    """Return the factor that holds one pose where it is."""
    exactly = gtsam.noiseModel.Constrained.All(6)
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), exactly)


def fixed_keys(keys: Iterable[int], fix: Iterable[Fixable]) -> set[int]:
    """Return those of the keys whose kind of variable shall stay, all of it."""
    rows = rows_by_variable(keys)
    chosen = [_VARIABLES[name] for name in fix if name in _VARIABLES]
    if "extrinsics" in chosen:
        chosen.append("camera")
    return {key_of(of, row) for of in chosen for row in rows.get(of, np.zeros(0, int)).tolist()}


def fixes(map_: Map, values: Any, keys: Iterable[int]) -> list[Factor]:  # noqa: ANN401
    """Return factors that hold variables where the values have them.

    A solver may still move them by what rounding leaves; `with_solution(..., held=keys)` keeps their bits.
    """
    return [_hold(map_, values, key) for key in sorted(keys)]


def half_fixes(values: Any, fix: Iterable[Fixable]) -> list[Factor]:  # noqa: ANN401
    """Return factors that hold the rotations, or the translations, of extrinsics where the values have them."""
    rows = rows_by_variable(values.keys())
    sensors: tuple[Variable, ...] = ("extrinsics", "camera")
    keys = [key_of(of, row) for of in sensors for row in rows.get(of, np.zeros(0, int)).tolist()]
    places = {key: values.atPose3(key) for key in keys}
    made: list[Factor] = []
    for name in fix:
        if name == "extrinsics_rotation":
            made += [gtsam.PoseRotationPrior3D(k, T, _exactly(3)) for k, T in places.items()]
        elif name == "extrinsics_translation":
            made += [gtsam.PoseTranslationPrior3D(k, T, _exactly(3)) for k, T in places.items()]
    return made


def _hold(map_: Map, values: Any, key: int) -> Factor:  # noqa: ANN401
    variable, row = variable_of(key)
    if variable in ("velocity", "intrinsics", "time_offset"):
        held = values.atVector(key)
        return gtsam.PriorFactorVector(key, held, _exactly(len(held)))
    if variable == "bias":
        return gtsam.PriorFactorConstantBias(key, values.atConstantBias(key), _exactly(6))
    shape = shape_of(map_.landmarks.kind[row]) if variable == "landmark" else "pose"
    if shape == "plane":
        return OwnFactor(_exactly(3), [key], _same_plane(values.atOrientedPlane3(key)))
    if shape == "point2d":
        return gtsam.PriorFactorPoint2(key, values.atPoint2(key), _exactly(2))
    if shape == "point":
        return gtsam.PriorFactorPoint3(key, values.atPoint3(key), _exactly(3))
    return gtsam.PriorFactorPose3(key, values.atPose3(key), _exactly(6))


def _exactly(size: int) -> Any:  # noqa: ANN401
    return gtsam.noiseModel.Constrained.All(size)


def _same_plane(known: Any) -> Residual:  # noqa: ANN401
    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        if jacobians is not None:
            jacobians[0] = np.eye(3, order="F")  # where both are the same, which is all that occurs
        error: FloatArray = known.localCoordinates(values.atOrientedPlane3(keys[0]))
        return error

    return residual
