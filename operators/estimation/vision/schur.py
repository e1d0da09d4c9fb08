"""Points eliminated from the normal equations, so that what is left is as large as the poses are many.

All that a vertex saw of a point enters as a 3 x 3 information M and a gradient m, by the point in the vertex's
base. With G = [hat(p), -I], the derivative of that point by the pose (rotation first, on the right), and R, the
rotation of the vertex, the blocks of the normal equations are

    pose, pose: G^T M G    point, point: R M R^T    point, pose: R M G

Source: Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section 6; Agarwal et al., Bundle Adjustment
in the Large, ECCV 2010.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import hat

if TYPE_CHECKING:
    from scipy.sparse import csc_array


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Which vertices saw which points: in order of points, none twice."""

    pose: IntArray  # (P,) number of the vertex
    point: IntArray  # (P,) number of the point, not decreasing, none left out
    num_poses: int

    @property
    def num_points(self) -> int:
        return int(self.point[-1]) + 1 if len(self.point) else 0


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """The normal equations of a bundle."""

    pose: FloatArray  # (V, 6, 6)
    pose_gradient: FloatArray  # (V, 6)
    point: FloatArray  # (L, 3, 3)
    point_gradient: FloatArray  # (L, 3)
    cross: FloatArray  # (P, 3, 6) point by pose
    extra: FloatArray  # (B, B) of the sensors' variables
    extra_gradient: FloatArray  # (B,)
    pose_extra: FloatArray  # (V, 6, B)
    point_extra: FloatArray  # (L, 3, B)


def pose_blocks(
    pairs: Pairs, R: FloatArray, p_vertex: FloatArray, information: FloatArray, gradient: FloatArray
) -> Blocks:
    """Return the blocks without those of sensors, from what each pair (P,) saw.

    Args:
        pairs: Who saw what.
        R: Shape (P, 3, 3), rotations of the vertices.
        p_vertex: Shape (P, 3), the points in their bases.
        information: Shape (P, 3, 3).
        gradient: Shape (P, 3).
    """
    K = hat(p_vertex)
    MK = information @ K
    RM = R @ information
    by_pose = np.empty((len(R), 6, 6))
    by_pose[:, :3, :3], by_pose[:, :3, 3:] = -K @ MK, -np.swapaxes(MK, 1, 2)
    by_pose[:, 3:, :3], by_pose[:, 3:, 3:] = -MK, information
    toward_pose = np.concatenate([np.cross(gradient, p_vertex), -gradient], axis=1)
    num, size = pairs.num_poses, pairs.num_points
    return Blocks(
        pose=summed(pairs.pose, by_pose, num),
        pose_gradient=summed(pairs.pose, toward_pose, num),
        point=summed(pairs.point, RM @ np.swapaxes(R, 1, 2), size),
        point_gradient=summed(pairs.point, np.einsum("nij,nj->ni", R, gradient), size),
        cross=np.concatenate([R @ MK, -RM], axis=2),
        extra=np.zeros((0, 0)),
        extra_gradient=np.zeros(0),
        pose_extra=np.zeros((num, 6, 0)),
        point_extra=np.zeros((size, 3, 0)),
    )


def summed(number: IntArray, values: FloatArray, num: int) -> FloatArray:
    """Return the sums (num, ...) of values (N, ...) by number."""
    flat = values.reshape(len(values), -1)
    sums = np.empty((num, flat.shape[1]))
    for column in range(flat.shape[1]):
        sums[:, column] = np.bincount(number, weights=flat[:, column], minlength=num)
    return sums.reshape(num, *values.shape[1:])


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """What is left of a bundle without its points, and how to get them back."""

    normal: csc_array  # (6 V + B, 6 V + B)
    gradient: FloatArray  # (6 V + B,)
    root: FloatArray  # (L, 3, 3) inverse of the Cholesky factors of the points' blocks
    crossed: FloatArray  # (P, 3, 6) root times cross
    extra: FloatArray  # (L, 3, B) root times point_extra
    point_gradient: FloatArray  # (L, 3) root times the gradient

    def points(self, pairs: Pairs, step: FloatArray) -> FloatArray:
        """Return the step of the points (L, 3) that belongs to one of poses and sensors (6 V + B,)."""
        poses = step[: 6 * pairs.num_poses].reshape(-1, 6)
        pulled = np.einsum("nij,nj->ni", self.crossed, poses[pairs.pose])
        moved = summed(pairs.point, pulled, pairs.num_points) + self.point_gradient
        moved += self.extra @ step[6 * pairs.num_poses :]
        found: FloatArray = -np.einsum("nji,nj->ni", self.root, moved)
        return found


def eliminate(pairs: Pairs, blocks: Blocks, damping: float, stays: BoolArray) -> Eliminated:
    """Return the equations without points.

    Args:
        pairs: Who saw what.
        blocks: The normal equations.
        damping: Share of the diagonal that is added to it.
        stays: Points (L,) that do not move.
    """
    from scipy import sparse  # noqa: PLC0415  # takes most of a second to import

    root = _inverse_roots(blocks.point, damping)
    root[stays] = 0
    crossed = root[pairs.point] @ blocks.cross
    extra = root @ blocks.point_extra
    gradient = np.einsum("nij,nj->ni", root, blocks.point_gradient)
    num, size = pairs.num_poses, blocks.extra.shape[0]
    starts = np.searchsorted(pairs.point, np.arange(pairs.num_points + 1))
    shape = (3 * pairs.num_points, 6 * num)
    rows = sparse.bsr_array((crossed, pairs.pose, starts), shape=shape)
    columns = rows.T.tobsr(blocksize=(6, 3))
    poses = sparse.bsr_array(
        (blocks.pose, np.arange(num), np.arange(num + 1)), shape=(6 * num,) * 2
    )
    flat = extra.reshape(shape[0], size)
    pose_extra = blocks.pose_extra.reshape(6 * num, size) - columns @ flat
    corner = blocks.extra - flat.T @ flat
    normal = sparse.block_array(
        [[poses - columns @ rows, sparse.coo_array(pose_extra)], [sparse.coo_array(pose_extra.T), sparse.coo_array(corner)]]
        if size
        else [[poses - columns @ rows]],
        format="csc",
    )  # fmt: skip
    reduced = np.concatenate([
        blocks.pose_gradient.ravel() - columns @ gradient.ravel(),
        blocks.extra_gradient - flat.T @ gradient.ravel(),
    ])  # fmt: skip
    return Eliminated(normal, reduced, root, crossed, extra, gradient)


def _inverse_roots(matrices: FloatArray, damping: float) -> FloatArray:
    """Return inverses (L, 3, 3) of lower Cholesky factors of damped matrices, written out for speed."""
    tiny = 1e-16 * np.trace(matrices, axis1=1, axis2=2) + 1e-30
    a, b, c = (matrices[:, k, k] * (1 + damping) + tiny for k in range(3))
    d, e, f = matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1]
    l11 = np.sqrt(a)
    l21, l31 = d / l11, e / l11
    l22 = np.sqrt(np.maximum(b - l21**2, tiny))
    l32 = (f - l31 * l21) / l22
    l33 = np.sqrt(np.maximum(c - l31**2 - l32**2, tiny))
    root = np.zeros_like(matrices)
    root[:, 0, 0], root[:, 1, 1], root[:, 2, 2] = 1 / l11, 1 / l22, 1 / l33
    root[:, 1, 0] = -l21 / (l11 * l22)
    root[:, 2, 1] = -l32 / (l22 * l33)
    root[:, 2, 0] = (l21 * l32 - l31 * l22) / (l11 * l22 * l33)
    return root
