"""How far an estimated trajectory is from a reference: APE, RPE and the KITTI drift.

Definitions follow evo (Grupp, 2017) and the KITTI odometry devkit (Geiger et al., CVPR 2012).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.recordings.pose_pairs import (
    Alignment,
    AlignmentMode,
    PosePairs,
    align,
    associate,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, so3_log

__all__ = [
    "Alignment",
    "AlignmentMode",
    "KittiDrift",
    "PoseErrors",
    "PosePairs",
    "Statistics",
    "align",
    "ape",
    "associate",
    "kitti_drift",
    "pose_errors",
    "rpe",
]

DeltaUnit = Literal["frames", "m"]
KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
_KITTI_STEP = 10  # frames between the starts of segments


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


def ape(pairs: PosePairs, mode: AlignmentMode = "se3") -> PoseErrors:
    """Return the absolute pose errors after alignment.

    Raises:
        EstimationError: As `align`.
    """
    return pose_errors(pairs, align(pairs, mode))


def pose_errors(pairs: PosePairs, alignment: Alignment) -> PoseErrors:
    """Return the absolute pose errors after a given alignment."""
    errors = invert(pairs.reference) @ alignment.apply(pairs.estimate)
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
