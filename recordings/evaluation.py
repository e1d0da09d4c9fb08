"""How far an estimated trajectory is from a reference: APE, RPE and the KITTI drift.

Definitions follow evo (Grupp, 2017; stamps, pairs, statistics) and the KITTI odometry devkit (Geiger et
al., CVPR 2012); alignment is Umeyama's (PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, so3_exp, so3_log
from mapstream.streams.messages.sensors import FloatArray, IntArray
from mapstream.streams.trajectory import Trajectory

AlignmentMode = Literal["se3", "sim3", "yaw", "none"]
DeltaUnit = Literal["frames", "m"]
KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
_KITTI_STEP = 10  # frames between the starts of segments
_RANK_TOLERANCE = 1e-9  # of the largest singular value


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """Of absolute errors, in their unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int

    @classmethod
    def of(cls, errors: FloatArray) -> Statistics:
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
            count=len(errors),
        )


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseErrors:
    """Errors of poses (APE) or of motions between poses (RPE)."""

    stamps_ns: IntArray  # (N,) of the estimate; of the later pose for a motion
    translation_m: FloatArray  # (N,)
    rotation_rad: FloatArray  # (N,)

    @property
    def translation(self) -> Statistics:
        return Statistics.of(self.translation_m)

    @property
    def rotation(self) -> Statistics:
        return Statistics.of(self.rotation_rad)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KittiDrift:
    """Errors of segments of 100 to 800 m, each divided by its length."""

    lengths_m: FloatArray  # (S,)
    translation: FloatArray  # (S,) [m/m]
    rotation_radpm: FloatArray  # (S,) [rad/m]

    @property
    def translation_percent(self) -> float:
        return float(100 * np.mean(self.translation))

    @property
    def rotation_degpm(self) -> float:
        return float(np.rad2deg(np.mean(self.rotation_radpm)))


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


def ape(pairs: PosePairs, mode: AlignmentMode = "se3") -> PoseErrors:
    """Return the absolute pose errors after alignment.

    Raises:
        EstimationError: As `align`.
    """
    aligned = align(pairs, mode).apply(pairs.estimate)
    errors = invert(pairs.reference) @ aligned
    return _errors(pairs.stamps_ns, errors)


def rpe(
    pairs: PosePairs, *, delta: float = 1, unit: DeltaUnit = "frames", all_pairs: bool = False
) -> PoseErrors:
    """Return the errors of motions over `delta`: no alignment is needed.

    Args:
        pairs: The poses.
        delta: Frames, or metres along the reference.
        unit: Of delta.
        all_pairs: Start at every pose, instead of where the motion before ended. By distance, motions
            then may miss delta by a tenth.

    Raises:
        EstimationError: If the trajectory is shorter than delta, or delta is no such length.
    """
    if delta <= 0 or (unit == "frames" and delta != int(delta)):
        raise EstimationError(
            f"relative errors over {delta:g} {unit}: give metres, or whole frames"
        )
    i, j = (_pairs_by_frames if unit == "frames" else _pairs_by_path)(
        pairs, delta, all_pairs=all_pairs
    )
    if not len(i):
        raise EstimationError(f"the trajectory is too short for motions over {delta:g} {unit}")
    motion = invert(pairs.estimate[i]) @ pairs.estimate[j]
    reference = invert(pairs.reference[i]) @ pairs.reference[j]
    return _errors(pairs.stamps_ns[j], invert(reference) @ motion)


def _pairs_by_frames(
    pairs: PosePairs, delta: float, *, all_pairs: bool
) -> tuple[IntArray, IntArray]:
    step = int(delta)
    starts = np.arange(0, len(pairs) - step, 1 if all_pairs else step)
    return starts, starts + step


def _pairs_by_path(pairs: PosePairs, delta: float, *, all_pairs: bool) -> tuple[IntArray, IntArray]:
    path_m = _path(pairs.reference)
    if all_pairs:
        ends = [_closest(path_m, k, delta) for k in range(len(path_m) - 1)]
        fits = [abs(path_m[e] - path_m[k] - delta) <= 0.1 * delta for k, e in enumerate(ends)]
        starts = np.flatnonzero(fits)
        return starts, np.array(ends, dtype=np.int64)[starts]
    ids, last_m = [0], 0.0
    for k, here_m in enumerate(path_m.tolist()):
        if here_m - last_m >= delta:
            ids.append(k)
            last_m = here_m
    rows = np.array(ids, dtype=np.int64)
    return rows[:-1], rows[1:]


def _closest(path_m: FloatArray, start: int, delta: float) -> int:
    return start + 1 + int(np.argmin(np.abs(path_m[start + 1 :] - path_m[start] - delta)))


def kitti_drift(pairs: PosePairs) -> KittiDrift:
    """Return the KITTI odometry metric.

    Raises:
        EstimationError: If the reference is shorter than 100 m.
    """
    path_m = _path(pairs.reference)
    segments = []
    for first in range(0, len(path_m), _KITTI_STEP):
        for length in KITTI_LENGTHS_M:
            last = int(np.searchsorted(path_m, path_m[first] + length, side="right"))
            if last < len(path_m):
                segments.append((first, last, length))
    if not segments:
        raise EstimationError(
            f"the KITTI metric needs segments of {KITTI_LENGTHS_M[0]} m; the reference is"
            f" {path_m[-1]:.1f} m long"
        )
    first_, last_, lengths_m = np.array(segments).T
    motion = invert(pairs.estimate[first_]) @ pairs.estimate[last_]
    reference = invert(pairs.reference[first_]) @ pairs.reference[last_]
    errors = _errors(pairs.stamps_ns[last_], invert(motion) @ reference)
    return KittiDrift(
        lengths_m=lengths_m.astype(np.float64),
        translation=errors.translation_m / lengths_m,
        rotation_radpm=errors.rotation_rad / lengths_m,
    )


def _path(poses: FloatArray) -> FloatArray:
    """Return the length of the path up to each pose [m]."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _errors(stamps_ns: IntArray, T: FloatArray) -> PoseErrors:
    return PoseErrors(
        stamps_ns=stamps_ns,
        translation_m=np.linalg.norm(T[:, :3, 3], axis=1),
        rotation_rad=np.linalg.norm(so3_log(T[:, :3, :3]), axis=1),
    )
