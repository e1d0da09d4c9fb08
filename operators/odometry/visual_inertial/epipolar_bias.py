"""A gyroscope's bias from tracks alone.

The rays of a point from two places span a plane that holds the line between the places, so the normals of
all planes are perpendicular to that line, if the rotation between the images is right: the smallest
eigenvalue of the sum of their outer products is zero then. No scale and no place is needed.
Source: Kneip and Lynen, Direct Optimization of Frame-to-Frame Rotation, ICCV 2013.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from mapstream.operators.odometry.visual.sightings import Sightings
from mapstream.operators.odometry.visual_inertial.integration import Integration
from mapstream.streams.arrays import FloatArray

_LEAST_COMMON = 8  # points in two images that make a pair
_STEP = 1e-4  # [rad/s] of the numerical derivative
_STEPS = 8
_Pair = tuple[int, int, FloatArray, FloatArray]  # two images, and the rays (N, 3) of common points


def epipolar_bias(sightings: Sightings, integration: Integration, sigma_radps: float) -> FloatArray:
    """Return the bias (3,) that makes epipolar planes meet.

    Args:
        sightings: Of K images, whose numbers are 0 to K - 1.
        integration: Between the images.
        sigma_radps: How far from zero it is likely to be.
    """
    pairs = _pairs(sightings, len(integration.frames))
    bias = np.zeros(3)
    if not pairs:
        return bias
    for _ in range(_STEPS):
        guesses = bias + np.vstack([np.zeros(3), np.eye(3) * _STEP])
        errors = np.array([_errors(pairs, R) for R in integration.rotations(guesses)])  # (4, P)
        J = (errors[1:] - errors[0]).T / _STEP
        prior = np.eye(3) * (1e-3 / sigma_radps) ** 2
        step = -np.linalg.solve(J.T @ J + prior, J.T @ errors[0] + prior @ bias)
        bias = bias + step
        if np.linalg.norm(step) < 1e-5:
            break
    return bias


def _pairs(sightings: Sightings, num_images: int) -> list[_Pair]:
    """Return pairs of images of one camera with enough points in common."""
    _, camera = np.unique(sightings.offsets, axis=0, return_inverse=True)
    pairs: list[_Pair] = []
    for number in np.unique(camera):
        seen = sightings.chosen(camera.ravel() == number)
        images = [seen.chosen(seen.images == k) for k in range(num_images)]
        for a, b in combinations(range(num_images), 2):
            _, i, j = np.intersect1d(images[a].keys, images[b].keys, return_indices=True)
            if len(i) >= _LEAST_COMMON:
                pairs.append((a, b, images[a].rays[i], images[b].rays[j]))
    return pairs


def _errors(pairs: list[_Pair], R: FloatArray) -> list[float]:
    """Return how far the planes of each pair are from meeting, for rotations (K, 3, 3) of the images."""
    errors = []
    for a, b, rays_a, rays_b in pairs:
        normals = np.cross(rays_a @ R[a].T, rays_b @ R[b].T)
        least = np.linalg.eigvalsh(normals.T @ normals / len(normals))[0]
        errors.append(float(np.sqrt(max(least, 0.0) + 1e-12)))
    return errors
