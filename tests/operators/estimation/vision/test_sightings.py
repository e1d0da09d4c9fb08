"""Residuals of observations: their derivatives by everything against central differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.vision.schur import Pairs, eliminate, pose_blocks
from mapstream.operators.estimation.vision.sightings import (
    SensorState,
    Sightings,
    errors,
    intrinsics_of,
    residuals,
)
from mapstream.operators.landmarks.motion import Moments
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, Distortion
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import hat, se3_exp
from tests.operators.vision_worlds import mounted

LENSES: dict[Distortion, list[float]] = {
    "none": [],
    "radtan": [-0.2, 0.05, 1e-3, -5e-4],
    "equidistant": [-0.02, 0.01, -0.003, 0.001],
    "fov": [0.9],
    "rational_polynomial": [0.1, 0.02, 1e-3, -5e-4, 0.001, 0.2, 0.03, 0.001],
}


def camera(xi: float | None, lens: Distortion) -> CameraCalibration:
    return CameraCalibration(
        model="pinhole" if xi is None else "unified", xi=xi, width_px=640, height_px=480,
        focal_px=np.array([400.0, 405]), center_px=np.array([320.0, 240]),
        distortion=lens, distortion_parameters=np.array(LENSES[lens]),
    )  # fmt: skip


def seen_by(sensor: SensorState, rng: np.random.Generator) -> tuple[Sightings, FloatArray]:
    """Six points before a moving camera, and where they are in the bases of their vertices."""
    T = se3_exp(rng.normal(0, 0.05, (6, 6)))
    twists = rng.normal(0, 0.5, (6, 6))
    p_sensor = np.column_stack([rng.uniform(-1.5, 1.5, (6, 2)), rng.uniform(3, 6, 6)])
    now = T @ se3_exp(sensor.time_offset_s * twists) @ sensor.T_base_sensor
    p_vertex = np.einsum("nij,nj->ni", now[:, :3, :3], p_sensor) + now[:, :3, 3]
    measured = p_sensor + 0.01
    if sensor.calibration is not None:
        measured = project(sensor.calibration, p_sensor)[0] + 1.0
    seen = Sightings(
        family="points" if sensor.calibration is None else "keypoints",
        sensor=0,
        rows=np.arange(6),
        pair=np.arange(6),
        measured=measured,
        sigmas=rng.uniform(0.5, 2, 6),
        loss=None,
        loss_width=3.0,
        gate=np.full(6, 100.0),
        moments=Moments(T, twists),
    )
    return seen, p_vertex


def central(at: Callable[[FloatArray], FloatArray], size: int, step: float = 1e-6) -> FloatArray:
    """Return derivatives (N, M, size) of a function at zero."""
    ends = [(at(step * row), at(-step * row)) for row in np.eye(size)]
    return np.stack([(up - down) / (2 * step) for up, down in ends], axis=2)


@pytest.mark.parametrize("xi", [None, 0.8, 1.2])
@pytest.mark.parametrize("lens", [*LENSES, None])
def test_E5_derivatives_of_all_camera_models(xi: float | None, lens: Distortion | None) -> None:
    """By the pose, the point, the place of the camera, its intrinsics and its clock; and of 3D points."""
    rng = np.random.default_rng(0)
    calibration = None if lens is None else camera(xi, lens)
    sensor = SensorState(mounted((0.1, 0.2, 0.3), (0.1, 0.2, 0.1)).matrix, calibration, 0.01)
    seen, p_vertex = seen_by(sensor, rng)

    found = residuals(seen, p_vertex, sensor)

    def by_pose(xi_pose: FloatArray) -> FloatArray:
        T = np.linalg.inv(se3_exp(xi_pose))
        return errors(seen, p_vertex @ T[:3, :3].T + T[:3, 3], sensor)

    def by_mount(xi_mount: FloatArray) -> FloatArray:
        moved = replace(sensor, T_base_sensor=sensor.T_base_sensor @ se3_exp(xi_mount))
        return errors(seen, p_vertex, moved)

    def by_time(late_s: FloatArray) -> FloatArray:
        return errors(seen, p_vertex, replace(sensor, time_offset_s=0.01 + float(late_s[0])))

    G = np.concatenate([hat(p_vertex), np.tile(-np.eye(3), (6, 1, 1))], axis=2)
    np.testing.assert_allclose(found.errors, errors(seen, p_vertex, sensor), rtol=1e-12)
    for analytic, numeric in (
        (found.by_vertex_point, central(lambda d: errors(seen, p_vertex + d, sensor), 3)),
        (found.by_vertex_point @ G, central(by_pose, 6)),
        (found.by_mount, central(by_mount, 6)),
        (found.by_time_offset, central(by_time, 1)),
    ):
        np.testing.assert_allclose(analytic, numeric, rtol=2e-5, atol=2e-4)
    if calibration is not None:
        known = intrinsics_of(calibration)
        numeric = central(lambda d: errors(seen, p_vertex, sensor.with_intrinsics(known + d)), len(known))  # fmt: skip
        np.testing.assert_allclose(found.by_intrinsics, numeric, rtol=2e-5, atol=2e-4)


def test_eliminated_points_leave_the_same_solution() -> None:
    """The reduced equations and the whole ones have the same steps."""
    rng = np.random.default_rng(0)
    pairs = Pairs(np.array([0, 1, 2, 0, 2, 1, 2]), np.array([0, 0, 0, 1, 1, 2, 2]), 3)
    R, p = se3_exp(rng.normal(size=(7, 6)))[:, :3, :3], rng.normal(size=(7, 3))
    A, e = rng.normal(size=(7, 4, 3)), rng.normal(size=(7, 4))
    At = np.swapaxes(A, 1, 2)
    blocks = pose_blocks(pairs, R, p, At @ A, np.einsum("nij,nj->ni", At, e))
    G = np.concatenate([hat(p), np.tile(-np.eye(3), (7, 1, 1))], axis=2)
    J = np.zeros((7, 4, 27))
    for k, (pose, point) in enumerate(zip(pairs.pose, pairs.point, strict=True)):
        J[k][:, 6 * pose : 6 * pose + 6] = A[k] @ G[k]
        J[k][:, 18 + 3 * point : 21 + 3 * point] = A[k] @ R[k].T
    flat = J.reshape(-1, 27)
    lengths = (flat**2).sum(axis=0)
    whole = np.linalg.solve(flat.T @ flat + 1e-3 * np.diag(lengths), -flat.T @ e.ravel())

    left = eliminate(pairs, blocks, 1e-3, np.zeros(3, bool))
    damped = left.normal.toarray() + 1e-3 * np.diag(lengths[:18])
    step = np.linalg.solve(damped, -left.gradient)

    np.testing.assert_allclose(step, whole[:18], rtol=1e-7)
    np.testing.assert_allclose(left.points(pairs, step).ravel(), whole[18:], rtol=1e-7)
