"""Which tracks fit one translation when the rotation is known: RANSAC with two points.

Source: Kneip, Chli, Siegwart, Robust Real-Time Visual Odometry with a Single Camera and an IMU, BMVC 2011.
The two rays of a point, turned into one frame, span a plane in which the translation lies; two planes tell it.
"""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig, warn
from mapstream.operators.tracking.epipolar import off_arc
from mapstream.streams.arrays import BoolArray, FloatArray

_MIN_TRACKS = 6  # with fewer, agreement means nothing


class OutlierOptions(OperatorConfig):
    """How tracks are checked against the motion of the camera."""

    max_outlier_angle_deg: PositiveFloat = 0.5
    """So far a ray may be from where one motion of the camera allows it."""
    num_trials: PositiveInt = 200
    """Translations that are tried."""


def agreeing(
    rays_before: FloatArray,
    rays_now: FloatArray,
    R_now_before: FloatArray,
    options: OutlierOptions,
    seed: int,
) -> BoolArray:
    """Return which tracks (N,) agree with the translation that most of them agree with.

    A point that only turned agrees with every translation, so a camera that stands loses nothing.
    If no translation has a majority, it is the rotation that is wrong: that is reported, and no track blamed.

    Args:
        rays_before: (N, 3) unit rays in the first image.
        rays_now: (N, 3) unit rays in the second one; a row that is not finite never agrees.
        R_now_before: Known rotation.
        options: Threshold and number of trials.
        seed: Of the trials; the stamp, so that a run can be repeated.
    """
    start = rays_before @ R_now_before.T
    normals = np.cross(start, rays_now)
    agree: BoolArray = np.isfinite(normals.sum(axis=1))
    rows = np.flatnonzero(agree)
    if len(rows) < _MIN_TRACKS:
        return agree
    first, second = rows[
        np.random.default_rng(seed).integers(0, len(rows), (2, options.num_trials))
    ]
    goals = np.cross(normals[first], normals[second])
    moved = rays_now - start
    is_against = ((moved[first] + moved[second]) * goals).sum(axis=1) < 0
    goals[is_against] *= -1
    lengths = np.linalg.norm(goals, axis=1, keepdims=True)
    goals = (goals / np.where(lengths > 0, lengths, 1))[lengths[:, 0] > 0]
    if len(goals) == 0:  # nothing moved
        return agree
    limit_rad = np.radians(options.max_outlier_angle_deg)
    missed = off_arc(start[rows], rays_now[rows], goals, limit_rad)
    # what many translations fit tells them apart by how well
    best = np.argmin(np.minimum(missed, limit_rad).sum(axis=1))
    fits = np.isfinite(missed[best])
    if 2 * fits.sum() > len(rows):
        agree[rows] = fits
    else:
        warn("most tracks disagree with the gyroscope; are its extrinsics and its clock right?")
    return agree
