"""The motion between two views: the one that makes colours and depths agree best.

Each point of the reference tells a gray level and a depth, and is compared with the pixel that it falls on in the
other view, from small images to large ones. The Jacobians are those of the reference and stay (inverse
compositional); weights are those of a t-distribution in two dimensions, whose covariance is estimated as well.
Source: Kerl, Sturm, Cremers: Robust Odometry Estimation for RGB-D Cameras, ICRA 2013, and Dense Visual SLAM for RGB-D
Cameras, IROS 2013, sections III-A to III-C; Baker and Matthews: Lucas-Kanade 20 Years On, IJCV 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.operators.odometry.dense.views import Level, Points
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert, se3_exp, se3_log, straightened, symmetric

_FREEDOM = 5.0  # of the t-distribution (Kerl et al.: 5 for their cameras)
_MAX_STEPS = 15  # at each size
_STILL = 0.01  # a step of so much of a pixel is the last one at a size
_LEAST_POINTS = 100  # that both views show
_FIRST_SIGMA = (40.0, 10.0)  # of gray levels, and of depths in sigmas of the camera
_LEAST_SIGMA = (1.0, 0.3)
_NEAREST_M = np.float32(1e-3)  # of a point: behind the camera there is none
_UNSEEN = 1e-6  # information of what the images do not tell
_CORRELATION = 100.0  # neighbouring pixels share their errors, and those of shutter and calibration: so many count as one


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a view is, seen from the reference."""

    T_reference_view: FloatArray  # (4, 4)
    covariance: (
        FloatArray  # (6, 6) perturbed on the right, rotation first [rad, m], of the images alone
    )
    overlap: float  # share of the reference's points that the view shows
    correlation: float  # of the gray levels of both, from -1 to 1


@dataclass(frozen=True, eq=False)
class Prior:
    """Where the view should be, and how sure that is."""

    T_reference_view: FloatArray  # (4, 4)
    information: FloatArray  # (6, 6)


def align(reference: Sequence[Level], view: Sequence[Level], prior: Prior) -> Alignment:
    """Return where a view is, starting from where it should be.

    Args:
        reference: At several sizes, the largest first.
        view: At the same sizes.
        prior: Its information counts as if measured, but not in the covariance of the result.

    Raises:
        EstimationError: If the views share too little.
    """
    T, A = invert(prior.T_reference_view), np.eye(6)
    for of_reference, of_view in zip(reversed(reference), reversed(view), strict=True):
        points = of_reference.points
        if len(points.xyz) < _LEAST_POINTS and of_reference is not reference[0]:
            continue
        sigma: FloatArray = np.diag(np.square(_FIRST_SIGMA))
        for _ in range(_MAX_STEPS):
            A, b, sigma = _linearized(points, _compared(points, of_view, T), sigma)
            # the step moves the reference's points, its inverse the view: T <- T exp(-step)
            apart = se3_log(invert(T) @ invert(prior.T_reference_view))
            step = np.linalg.solve(A + prior.information, b - prior.information @ apart)
            T = straightened(T @ se3_exp(-step))
            if np.abs(step).max() * of_view.focal_px[0] < _STILL:
                break
    compared = _compared(reference[0].points, view[0], T)
    adjoint = SE3(T).adjoint()  # what moves the reference's points, seen from the view
    covariance = _CORRELATION * adjoint @ np.linalg.inv(A + _UNSEEN * np.eye(6)) @ adjoint.T
    return Alignment(
        T_reference_view=invert(T),
        covariance=symmetric(covariance),
        overlap=float(compared.known.mean()),
        correlation=compared.correlation,
    )


@dataclass(frozen=True, eq=False)
class _Compared:
    """The points of the reference beside the pixels that they fall on, in gray levels and sigmas of depth."""

    known: BoolArray  # (N,) where the view tells both
    gray: Float32Array  # (N,) of the reference; 0 where not known, as are the next two
    off_gray: Float32Array  # (N,) of the view, less that
    off_depth: Float32Array  # (N,)

    @property
    def correlation(self) -> float:
        """Return that of the gray levels; 0 if one of the images has no contrast."""
        a, b = self.gray[self.known], (self.gray + self.off_gray)[self.known]
        spread = float(a.std() * b.std())
        return float(((a - a.mean()) * (b - b.mean())).mean()) / spread if spread > 0 else 0.0


def _compared(points: Points, view: Level, T: FloatArray) -> _Compared:
    """Compare with a view at a motion T_view_reference.

    Raises:
        EstimationError: If too few points are seen again.
    """
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    moved = points.xyz @ R.T + t
    (fx, fy), (cx, cy) = view.focal_px, view.center_px
    z = np.maximum(moved[:, 2], _NEAREST_M)
    px = (moved[:, 0] / z * fx + cx, moved[:, 1] / z * fy + cy)
    gray, depth_m = (_sampled(image, *px) for image in (view.gray, view.depth_m))
    known = np.isfinite(gray + depth_m)
    if np.count_nonzero(known) < _LEAST_POINTS:
        raise EstimationError(
            f"{np.count_nonzero(known)} points seen again, {_LEAST_POINTS} are needed"
        )
    off_gray = gray - points.gray
    off_gray -= np.median(off_gray[known])  # another exposure
    off_depth = (depth_m - z) / points.sigma_m
    return _Compared(known, *(np.where(known, a, 0) for a in (points.gray, off_gray, off_depth)))


def _sampled(image: Float32Array, x: Float32Array, y: Float32Array) -> Float32Array:
    """Return the values (N,) at pixels; NaN beyond the image."""
    found = cv2.remap(
        image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    return np.asarray(found, np.float32).ravel()


def _linearized(
    points: Points, compared: _Compared, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the normal equations (6, 6) and (6,), and the covariance (2, 2) of gray levels and depths."""
    weights, sigma = _weighted(compared, sigma)
    (g, m), (_, d) = np.linalg.inv(sigma).astype(np.float32)
    # both rows of each point, mixed by the inverse covariance
    by_gray = (g * points.J_gray + m * points.J_depth) * weights[:, None]
    by_depth = (m * points.J_gray + d * points.J_depth) * weights[:, None]
    A = by_gray.T @ points.J_gray + by_depth.T @ points.J_depth
    b = by_gray.T @ compared.off_gray + by_depth.T @ compared.off_depth
    return symmetric(A.astype(np.float64)), b.astype(np.float64), sigma


def _weighted(compared: _Compared, sigma: FloatArray) -> tuple[Float32Array, FloatArray]:
    """Return the weights (N,), 0 where nothing is known, and the covariance (2, 2) that goes with them."""
    gray, depth = compared.off_gray, compared.off_depth
    (g, m), (_, d) = np.linalg.inv(sigma)
    distance = g * gray**2 + 2 * m * gray * depth + d * depth**2
    weights = np.where(compared.known, (_FREEDOM + 2) / (_FREEDOM + distance), 0)
    weights = weights.astype(np.float32)
    both = np.stack([gray, depth])
    found = (both * weights) @ both.T / np.count_nonzero(compared.known)
    return weights, found.astype(np.float64) + np.diag(np.square(_LEAST_SIGMA))
