"""Which loops agree with odometry alone: a first guess at the true ones that needs no optimisation.

The chain of odometry between the ends of a loop has a covariance of its own, and a true loop lies within both
(the odometric consistency of Mangelson et al., ICRA 2018, section V, for all loops at once).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.geometry import hat, invert, se3_log
from mapstream.streams.messages.sensors import FloatArray, IntArray

MOTION_KINDS = ("odometry", "wheel", "registration", "motion_model")


def cycle_chi2(map_: Map, loop_rows: IntArray) -> FloatArray:
    """Return the chi2 (N,) of the cycle that each loop closes with odometry; NaN where none links its ends."""
    edges = map_.edges
    poses, covariance, run = _chain(map_)
    a, b = edges.vertex_a[loop_rows], edges.vertex_b[loop_rows]
    chi2 = np.full(len(loop_rows), np.nan)
    linked = np.flatnonzero((b >= 0) & (run[a] == run[b]) & (run[a] >= 0))
    a, b, rows = a[linked], b[linked], loop_rows[linked]
    spread = np.where((b >= a)[:, None, None], covariance[b] - covariance[a], 0.0)
    spread += np.where((b < a)[:, None, None], covariance[a] - covariance[b], 0.0)
    to_b = adjoint(invert(poses[b]))
    total = to_b @ spread @ np.swapaxes(to_b, 1, 2) + edges.covariance[rows]
    left = se3_log(invert(edges.T_a_b[rows]) @ invert(poses[a]) @ poses[b])
    is_open = ~np.isfinite(np.diagonal(total, axis1=1, axis2=2))
    total = np.where(is_open[:, :, None] | is_open[:, None, :], np.eye(6), total)
    left = np.where(is_open, 0.0, left)
    chi2[linked] = np.einsum("ni,ni->n", left, np.linalg.solve(total, left[..., None])[..., 0])
    return chi2


def adjoint(T: FloatArray) -> FloatArray:
    """Return the adjoints (N, 6, 6) of transforms (N, 4, 4), rotation first."""
    result = np.zeros((len(T), 6, 6))
    R = T[:, :3, :3]
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return result


def _chain(map_: Map) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return poses by odometry (N, 4, 4), their covariance in the first one's frame, and the run they are in.

    A run is a stretch of one mission's vertices that odometry links without a gap.
    """
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
    return poses, covariance, run


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
    to_first = adjoint(poses[1:])
    spread = np.zeros((len(poses), 6, 6))
    spread[1:] = np.cumsum(to_first @ covariance @ np.swapaxes(to_first, 1, 2), axis=0)
    return poses, spread
