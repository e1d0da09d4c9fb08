"""Poses of two trajectories that belong together, and the transform that lays one onto the other.

Stamps are paired as evo does (Grupp, 2017); alignment is Umeyama's (PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import so3_exp
from mapstream.streams.trajectory import Trajectory

AlignmentMode = Literal["se3", "sim3", "yaw", "none"]
_RANK_TOLERANCE = 1e-9  # of the largest singular value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePairs:
    """Poses of an estimate and a reference that belong to the same instants."""

    stamps_ns: IntArray  # (N,) of the estimate
    estimate: FloatArray  # (N, 4, 4)
    reference: FloatArray  # (N, 4, 4)

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """What carries the estimate onto the reference: `p_reference = scale * R @ p_estimate + t`."""

    R: FloatArray  # (3, 3)
    t: FloatArray  # (3,) [m]
    scale: float = 1.0

    def apply(self, poses: FloatArray) -> FloatArray:
        """Return aligned poses (N, 4, 4)."""
        aligned = poses.copy()
        aligned[:, :3, :3] = self.R @ poses[:, :3, :3]
        aligned[:, :3, 3] = self.scale * poses[:, :3, 3] @ self.R.T + self.t
        return aligned


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    max_difference_ns: int = 10_000_000,
    interpolate: bool = False,
) -> PosePairs:
    """Pair the poses of two trajectories by stamp.

    Args:
        estimate: What is judged.
        reference: What it is judged by.
        max_difference_ns: Between the stamps of a pair. Each pose of the shorter trajectory takes the
            nearest of the longer, as evo does.
        interpolate: Ask the reference for its pose at each stamp of the estimate instead.

    Raises:
        EstimationError: If nothing matches; the message has both spans.
    """
    if interpolate:
        keep = np.array([reference.covers(ns) for ns in estimate.stamps_ns.tolist()], dtype=bool)
        left, poses = np.flatnonzero(keep), reference.poses[:0]
        poses = reference.at(estimate.stamps_ns[left]) if len(left) else poses
    else:
        left, right = _nearest(estimate.stamps_ns, reference.stamps_ns, max_difference_ns)
        poses = reference.poses[right]
    if not len(left):
        spans = " and ".join(
            f"{t.stamps_ns[0]} to {t.stamps_ns[-1]} ns" if len(t) else "nothing"
            for t in (estimate, reference)
        )
        raise EstimationError(
            f"no stamps match: estimate and reference span {spans}; check the clocks, or allow more"
            f" than {max_difference_ns / 1e6:g} ms between stamps"
        )
    return PosePairs(
        stamps_ns=estimate.stamps_ns[left], estimate=estimate.poses[left], reference=poses
    )


def _nearest(a_ns: IntArray, b_ns: IntArray, limit_ns: int) -> tuple[IntArray, IntArray]:
    """Return rows of a and b whose stamps match; the shorter one decides."""
    if len(b_ns) < len(a_ns):
        right, left = _nearest(b_ns, a_ns, limit_ns)
        return left, right
    if not len(a_ns):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    after = np.clip(np.searchsorted(b_ns, a_ns), 1, max(1, len(b_ns) - 1))
    before, after = after - 1, np.minimum(after, len(b_ns) - 1)
    nearest = np.where(a_ns - b_ns[before] <= b_ns[after] - a_ns, before, after)
    rows = np.flatnonzero(np.abs(b_ns[nearest] - a_ns) <= limit_ns)
    return rows, nearest[rows]


def align(pairs: PosePairs, mode: AlignmentMode = "se3") -> Alignment:
    """Return what brings the estimated positions closest to the reference, in least squares.

    `yaw` turns about z only, for frames that both know gravity.

    Raises:
        EstimationError: If the positions do not determine it: too few, or on one line.
    """
    if mode == "none":
        return Alignment(R=np.eye(3), t=np.zeros(3))
    x, y = pairs.estimate[:, :3, 3], pairs.reference[:, :3, 3]
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    x, y = x - x_mean, y - y_mean
    covariance = y.T @ x / len(x)
    scale = 1.0
    if mode == "yaw":
        sine, cosine = covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]
        if np.hypot(sine, cosine) == 0:
            raise EstimationError("yaw alignment: the positions are one point; use none")
        R = so3_exp([0.0, 0.0, np.arctan2(sine, cosine)])
    else:
        U, singular, Vt = np.linalg.svd(covariance)
        if singular[1] <= _RANK_TOLERANCE * singular[0] or singular[0] == 0:
            raise EstimationError(
                f"{mode} alignment: {len(pairs)} positions lie on one line, which leaves the roll"
                " about it open; align yaw only, or nothing"
            )
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
        R = U @ np.diag(signs) @ Vt
        if mode == "sim3":
            scale = float(singular @ signs / np.mean(np.sum(x * x, axis=1)))
    return Alignment(R=R, t=y_mean - scale * R @ x_mean, scale=scale)
