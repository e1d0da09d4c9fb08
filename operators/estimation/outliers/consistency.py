"""Which loops agree with odometry alone, and with each other: a first guess that needs no optimisation.

The chain of odometry between the ends of a loop has a covariance of its own, and a true loop lies within both
(the odometric consistency of Mangelson et al., ICRA 2018, section V, for all loops at once).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat, invert, se3_log


@dataclass(frozen=True, slots=True)
class OdometryChain:
    """Where odometry alone puts the vertices of each mission.

    A run is a stretch of one mission's vertices that odometry links without a gap; its first is the identity.
    """

    poses: FloatArray  # (N, 4, 4) in the frame of the run
    covariance: FloatArray  # (N, 6, 6) of all steps so far, in the frame of the run
    run: IntArray  # (N,)

    def spread(self, a: IntArray, b: IntArray) -> FloatArray:
        """Return the covariance (M, 6, 6) of the steps between vertices of one run, in its frame."""
        sign = np.where(b >= a, 1.0, -1.0)[:, None, None]
        between: FloatArray = sign * (self.covariance[b] - self.covariance[a])
        return between


def cycle_chi2(map_: Map, loop_rows: IntArray) -> FloatArray:
    """Return the chi2 (N,) of the cycle that each loop closes with odometry; NaN where none links its ends."""
    edges, chain = map_.edges, odometry_chain(map_)
    a, b = edges.vertex_a[loop_rows], edges.vertex_b[loop_rows]
    chi2 = np.full(len(loop_rows), np.nan)
    linked = np.flatnonzero((a >= 0) & (b >= 0) & (chain.run[a] == chain.run[b]))
    a, b, rows = a[linked], b[linked], loop_rows[linked]
    total = in_frame(chain.spread(a, b), invert(chain.poses[b])) + edges.covariance[rows]
    left = se3_log(invert(edges.T_a_b[rows]) @ invert(chain.poses[a]) @ chain.poses[b])
    chi2[linked] = mahalanobis(left, total)
    return chi2


def mahalanobis(left: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the chi2 (...) of residuals (..., 6); directions of infinite variance count nothing."""
    is_open = ~np.isfinite(np.diagonal(covariance, axis1=-2, axis2=-1))
    crossing = is_open[..., :, None] | is_open[..., None, :]
    left = np.where(is_open, 0.0, left)
    weighted = np.linalg.solve(np.where(crossing, np.eye(6), covariance), left[..., None])
    chi2: FloatArray = np.einsum("...i,...i->...", left, weighted[..., 0])
    return chi2


def chi2_gate(directions: IntArray | int, probability: float) -> FloatArray:
    """Return what the chi2 of this many directions stays below with a probability."""
    from scipy.special import gammaincinv  # noqa: PLC0415  # chi2's quantiles, without scipy.stats

    quantiles: FloatArray = 2 * gammaincinv(np.asarray(directions) / 2, probability)
    return quantiles


def in_frame(covariance: FloatArray, T: FloatArray) -> FloatArray:
    """Return covariances (N, 6, 6) as seen from another frame, by transforms (N, 4, 4) or one (4, 4)."""
    to = adjoint(T)
    moved: FloatArray = to @ covariance @ np.swapaxes(to, -1, -2)
    return moved


def adjoint(T: FloatArray) -> FloatArray:
    """Return the adjoints (..., 6, 6) of transforms (..., 4, 4), rotation first."""
    result = np.zeros((*T.shape[:-2], 6, 6))
    R = T[..., :3, :3]
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return result


def odometry_chain(map_: Map) -> OdometryChain:
    """Return where odometry puts the vertices; those of two runs cannot be compared."""
    edges, num = map_.edges, len(map_.vertices)
    poses = np.tile(np.eye(4), (num, 1, 1))
    covariance, run = np.zeros((num, 6, 6)), np.full(num, -1)
    is_motion = np.isin(edges.kind, MOTION_KINDS) & (edges.vertex_b >= 0)
    measured = np.isfinite(np.diagonal(edges.covariance, axis1=1, axis2=2)).all(axis=1)
    motion = np.flatnonzero(is_motion & measured)
    ends = zip(edges.vertex_a[motion].tolist(), edges.vertex_b[motion].tolist(), strict=True)
    link_of = dict(zip(ends, motion.tolist(), strict=True))
    number = 0
    for mission in range(len(map_.missions)):
        vertices = map_.vertices_of(mission)
        rows = [link_of.get(pair, -1) for pair in pairwise(vertices.tolist())]
        for first, last in _runs(rows):
            members, links = vertices[first : last + 1], np.array(rows[first:last], np.int64)
            poses[members], covariance[members] = _integrated(
                edges.T_a_b[links], edges.covariance[links]
            )
            run[members] = number
            number += 1
    return OdometryChain(poses, covariance, run)


def _runs(rows: list[int]) -> list[tuple[int, int]]:
    """Return first and last of each stretch of vertices without a missing link between them."""
    gaps = [k for k, row in enumerate(rows) if row < 0]
    firsts = [0, *(k + 1 for k in gaps)]
    lasts = [*gaps, len(rows)]
    return list(zip(firsts, lasts, strict=True))


def _integrated(steps: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    poses = np.empty((len(steps) + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, step in enumerate(steps):
        poses[k + 1] = poses[k] @ step
    spread = np.zeros((len(poses), 6, 6))
    spread[1:] = np.cumsum(in_frame(covariance, poses[1:]), axis=0)
    return poses, spread
