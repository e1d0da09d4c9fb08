"""The planar motion that most pairs of points agree on.

Source: Fischler and Bolles, Random sample consensus, CACM 1981; the fit is Horn's in the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import SE3, so3_exp

_MIN_BASELINE_M = 2.0  # between the two points of a sample; closer ones say little of the turn
_ROUNDS = 3  # of fitting to what agrees


@dataclass(frozen=True, slots=True, eq=False)
class PlanarMotion:
    """Target = turn and shift of source, in the plane."""

    T_target_source: SE3  # about z, along x and y
    is_inlier: BoolArray  # (N,)

    @property
    def num_inliers(self) -> int:
        return int(self.is_inlier.sum())


def planar_motion(
    source: FloatArray, target: FloatArray, *, tolerance_m: float, num_samples: int, seed: int
) -> PlanarMotion:
    """Return the motion that takes most of the points (N, 2) of the source to those of the target.

    Without three pairs that agree no point is an inlier.
    """
    a, b = source @ [1, 1j], target @ [1, 1j]
    none = PlanarMotion(SE3.identity(), np.zeros(len(a), bool))
    if len(a) < 3:
        return none
    first, second = np.random.default_rng(seed).integers(0, len(a), (2, num_samples))
    span_a, span_b = a[second] - a[first], b[second] - b[first]
    may_be = np.abs(np.abs(span_a) - np.abs(span_b)) < 2 * tolerance_m
    may_be &= np.minimum(np.abs(span_a), np.abs(span_b)) > _MIN_BASELINE_M
    if not may_be.any():
        return none
    turn = span_b[may_be] / span_a[may_be]
    turn /= np.abs(turn)
    middle_a, middle_b = (each[first][may_be] + each[second][may_be] for each in (a, b))
    shift = (middle_b - turn * middle_a) / 2
    agrees = np.abs(turn[:, None] * a + shift[:, None] - b) < tolerance_m  # (samples, N)
    is_inlier = agrees[int(np.argmax(agrees.sum(axis=1)))]
    fitted = (complex(1), complex(0))
    for _ in range(_ROUNDS):
        if is_inlier.sum() < 3:
            return none
        fitted = _fit(a[is_inlier], b[is_inlier])
        is_inlier = np.abs(fitted[0] * a + fitted[1] - b) < tolerance_m
    R = so3_exp([0.0, 0.0, float(np.angle(fitted[0]))])
    return PlanarMotion(SE3.from_rotation(R, [fitted[1].real, fitted[1].imag, 0.0]), is_inlier)


def _fit(
    a: np.ndarray[tuple[int], np.dtype[np.complex128]],
    b: np.ndarray[tuple[int], np.dtype[np.complex128]],
) -> tuple[complex, complex]:
    """Return the turn and the shift with the least squares."""
    turn = complex(np.vdot(a - a.mean(), b - b.mean()))
    turn = turn / abs(turn) if turn else complex(1)
    return turn, complex(b.mean() - turn * a.mean())
