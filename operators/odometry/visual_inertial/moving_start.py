"""The first state of a filter from a moving robot: gravity, velocity, biases, and with them the scale.

With the gyroscope's bias from epipolar planes the rotations are known, and points, first velocity and
gravity are linear in the keypoints. Then all of them, with the accelerometer's bias, are refined on the
keypoints; the IMU's motion is taken as exact but for its biases, which over a second or two it is.
Source: Dong-Si and Mourikis, Estimator Initialization in Vision-aided Inertial Navigation, IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.imu.samples import level_attitude
from mapstream.operators.odometry.visual.elimination import eliminate
from mapstream.operators.odometry.visual.sightings import Sightings, grouped
from mapstream.operators.odometry.visual_inertial.epipolar_bias import epipolar_bias
from mapstream.operators.odometry.visual_inertial.integration import Integrated, Integration
from mapstream.operators.odometry.visual_inertial.linear_start import MotionStart, linear_start
from mapstream.operators.odometry.visual_inertial.state import NUM_INERTIAL, FilterState
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import hat, so3_log

_LEAST_POINTS, _LEAST_VIEWS, _MOST_POINTS = 10, 4, 80
_BIAS_STEP = 1e-4  # of numerical derivatives
_LEAST_AGREED = 0.6  # of the points
_FAULT = 4.0  # times the expected sum of squares, from which on a track counts little (Cauchy)
_MOST_SPEED_SIGMA_MPS, _MOST_SCALE_SIGMA = 0.03, 0.1
_MOST_TILT_SIGMA_RAD = 0.05
_INFLATION = 4.0  # of the covariance: the filter looks at the same images again
_STEPS = 15


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A start, and how the keypoints like it."""

    start: MotionStart
    information: FloatArray  # (11, 11)
    vector: FloatArray  # (11,)
    cost: float
    agrees: BoolArray  # (F,) which points do
    moved: FloatArray  # (3,) [m] from the first image to the last

    @property
    def covariance(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.information))


def start_in_motion(
    sightings: Sightings, integration: Integration, imu: ImuQuality, stamp_ns: int
) -> FilterState | None:
    """Return the state at the first image; None if tracks and motion do not tell it well.

    Args:
        sightings: Of K images, whose numbers are 0 to K - 1.
        integration: Samples from the first image to the last.
        imu: Its noise.
        stamp_ns: Of the first image.
    """
    keys, counts = np.unique(sightings.keys, return_counts=True)
    order = np.lexsort((keys, -counts))[:_MOST_POINTS]
    chosen = keys[order[counts[order] >= _LEAST_VIEWS]]
    if len(chosen) < _LEAST_POINTS:
        return None
    sightings = sightings.chosen(np.isin(sightings.keys, chosen))
    gyro_bias = epipolar_bias(sightings, integration, imu.gyro_bias_sigma_radps)
    start = linear_start(sightings, integration, gyro_bias, imu.gravity_mps2)
    fit = _fitted(sightings, integration, start, imu)
    if not _is_good(fit, integration):
        return None
    return _state(fit.start, fit.covariance * _INFLATION, stamp_ns)


def _fitted(
    sightings: Sightings, integration: Integration, start: MotionStart, imu: ImuQuality
) -> _Fit:
    """Return the start that fits keypoints best, by Levenberg and Marquardt."""
    weights = np.repeat([imu.gyro_bias_sigma_radps, imu.accel_bias_sigma_mps2, 1e2], 3) ** -2.0
    weights = np.append(weights, [1e-6, 1e-6])
    fit = _fit(sightings, integration, start, imu, weights)
    damping = 1e-3
    for _ in range(_STEPS):
        N = fit.information + damping * np.diag(np.diag(fit.information))
        tried = fit.start.moved(np.asarray(np.linalg.solve(N, fit.vector)))
        after = _fit(sightings, integration, tried, imu, weights)
        if after.cost < fit.cost:
            is_done = fit.cost - after.cost < 1e-3 * fit.cost
            fit, damping = after, damping / 10
            if is_done:
                break
        else:
            damping *= 10
    return fit


def _fit(
    sightings: Sightings,
    integration: Integration,
    start: MotionStart,
    imu: ImuQuality,
    weights: FloatArray,
) -> _Fit:
    guess = _around(integration, start)
    places = _places(guess, start, imu)
    group = grouped(sightings, np.arange(len(places)), guess.R[0], places)
    found = eliminate(group, len(places))
    J = _by_start(guess, places, start, imu)
    excess = found.points.cost / np.maximum(
        group.views.freedom, 1
    )  # about 1 for a track without fault
    w = 1 / (1 + excess / _FAULT)
    of_poses, towards = found.information()
    information, vector = np.einsum("f,fij->ij", w, of_poses), w @ towards
    away = np.concatenate([start.gyro_bias, start.accel_bias, np.zeros(5)])
    return _Fit(
        start,
        J.T @ information @ J + np.diag(weights),
        J.T @ vector - weights * away,
        float(
            (
                _FAULT * np.log1p(excess / _FAULT) * found.points.cost / np.maximum(excess, 1e-9)
            ).sum()
        ),
        excess < _FAULT,
        places[-1] - places[0],
    )


def _around(integration: Integration, start: MotionStart) -> Integrated:
    """Return the motion for the biases of the start, and for each of the six moved a little."""
    steps = np.vstack([np.zeros(6), np.eye(6) * _BIAS_STEP])
    return integration.integrated(start.gyro_bias + steps[:, :3], start.accel_bias + steps[:, 3:])


def _places(guess: Integrated, start: MotionStart, imu: ImuQuality) -> FloatArray:
    """Return where the IMU was (K, 3) at the images, in the axes of the first."""
    times = guess.times_s[:, None]
    fall = imu.gravity_mps2 * start.down
    return np.asarray(guess.p[0] + start.velocity * times + fall * times**2 / 2)


def _by_start(
    guess: Integrated, places: FloatArray, start: MotionStart, imu: ImuQuality
) -> FloatArray:
    """Return how errors of the poses (6 K, 11), perturbed on the left, follow those of the start."""
    num = len(guess.times_s)
    J = np.zeros((num, 6, 11))
    turned = so3_log(guess.R[1:] @ np.swapaxes(guess.R[0], 1, 2)) / _BIAS_STEP  # (6, K, 3)
    moved = (guess.p[1:] - guess.p[0]) / _BIAS_STEP
    J[:, :3, :6] = np.moveaxis(turned, 0, 2)
    J[:, 3:, :6] = np.moveaxis(moved, 0, 2) + hat(places) @ J[:, :3, :6]
    times = guess.times_s[:, None, None]
    J[:, 3:, 6:9] = times * np.eye(3)
    J[:, 3:, 9:] = times**2 / 2 * imu.gravity_mps2 * start.sides
    return J.reshape(6 * num, 11)


def _is_good(fit: _Fit, integration: Integration) -> bool:
    """Return whether the points agree, and velocity, tilt and so the scale are known."""
    covariance = fit.covariance
    speed_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[6:9, 6:9])[-1]))
    tilt_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[9:, 9:])[-1]))
    speed_mps = float(np.linalg.norm(fit.moved)) / float(integration.times_s[-1])
    return bool(
        fit.agrees.mean() > _LEAST_AGREED
        and fit.agrees.sum() >= _LEAST_POINTS
        and speed_sigma < max(_MOST_SPEED_SIGMA_MPS, _MOST_SCALE_SIGMA * speed_mps)
        and tilt_sigma < _MOST_TILT_SIGMA_RAD
    )


def _state(start: MotionStart, covariance: FloatArray, stamp_ns: int) -> FilterState:
    """Return the start in a frame whose z is up, with its heading and place zero."""
    R = level_attitude(-start.down)
    to_errors = np.zeros((NUM_INERTIAL, 11))
    pull = hat([0.0, 0.0, -1.0])  # a turn moves the direction of gravity, seen from the IMU
    to_errors[:3, 9:] = np.linalg.pinv(pull) @ R @ start.sides
    to_errors[6:9, 6:9] = R
    to_errors[9:15, :6] = np.eye(6)
    P = to_errors @ covariance @ to_errors.T + np.eye(NUM_INERTIAL) * 1e-8
    return FilterState(
        stamp_ns=stamp_ns,
        R=R,
        p=np.zeros(3),
        v=R @ start.velocity,
        gyro_bias=start.gyro_bias,
        accel_bias=start.accel_bias,
        covariance=P,
    )
