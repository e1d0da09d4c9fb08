"""What the filter estimates, and how sure it is.

The IMU's pose in the odom frame, velocity and biases; the poses that it had at the last images (clones);
and points that are tracked for long. Errors of poses and velocity are those of the extended pose group,
perturbed on the left: T = exp(xi) T_estimate. With them the directions that nothing observes, position
and heading, stay unobserved however the estimates change, so no first estimates are kept for poses.
Source: Barrau and Bonnabel, The Invariant Extended Kalman Filter as a Stable Observer, TAC 2017;
Wu et al., An Invariant-EKF VINS Algorithm for Improving Consistency, IROS 2017.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, so3_exp

TURN, PLACE, VELOCITY, GYRO_BIAS, ACCEL_BIAS = (slice(k, k + 3) for k in range(0, 15, 3))
POSE = slice(0, 6)
NUM_INERTIAL = 15


@dataclass(slots=True, eq=False)
class FilterState:
    """Mutable: the filter's memory. The covariance has the order of the fields."""

    stamp_ns: int
    R: FloatArray  # (3, 3) R_odom_imu
    p: FloatArray  # (3,) [m]
    v: FloatArray  # (3,) [m/s], odom frame
    gyro_bias: FloatArray  # (3,) [rad/s]
    accel_bias: FloatArray  # (3,) [m/s^2]
    covariance: FloatArray  # (D, D), D = 15 + 6 K + 3 L
    clone_ids: IntArray = field(default_factory=lambda: np.empty(0, np.int64))  # (K,) increasing
    clone_R: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))  # noqa: N815  # R as in T_a_b
    clone_p: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    keys: IntArray = field(default_factory=lambda: np.empty(0, np.int64))  # (L,) of points
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (L, 3) [m]
    first_points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # where they began
    is_standing: bool = False  # whether the robot is known to stand

    @property
    def T_odom_imu(self) -> SE3:
        return SE3.from_rotation(self.R, self.p)

    @property
    def first_point_column(self) -> int:
        return NUM_INERTIAL + 6 * len(self.clone_ids)

    def clone_columns(self, index: int) -> slice:
        """Return the columns of a clone; -1 is the newest."""
        start = NUM_INERTIAL + 6 * (index % len(self.clone_ids))
        return slice(start, start + 6)

    def clone(self, clone_id: int) -> None:
        """Keep the pose of now."""
        at = self.first_point_column
        order = np.concatenate([np.arange(at), np.arange(6), np.arange(at, len(self.covariance))])
        self.covariance = self.covariance[np.ix_(order, order)]
        self.clone_ids = np.append(self.clone_ids, clone_id)
        self.clone_R = np.concatenate([self.clone_R, self.R[None]])
        self.clone_p = np.concatenate([self.clone_p, self.p[None]])

    def forget_clones(self, clone_ids: IntArray) -> None:
        """Drop poses: they are marginalised."""
        gone = np.isin(self.clone_ids, clone_ids)
        if not gone.any():
            return
        kept = np.ones(len(self.covariance), bool)
        kept[NUM_INERTIAL : self.first_point_column] = np.repeat(~gone, 6)
        self.covariance = self.covariance[np.ix_(kept, kept)]
        self.clone_ids = self.clone_ids[~gone]
        self.clone_R, self.clone_p = self.clone_R[~gone], self.clone_p[~gone]

    def forget_points(self, gone: npt.NDArray[np.bool_]) -> None:
        """Drop points (L,): they are marginalised."""
        if not gone.any():
            return
        kept = np.ones(len(self.covariance), bool)
        kept[self.first_point_column :] = np.repeat(~gone, 3)
        self.covariance = self.covariance[np.ix_(kept, kept)]
        self.keys = self.keys[~gone]
        self.points, self.first_points = self.points[~gone], self.first_points[~gone]

    def add_point(
        self, key: int, position: FloatArray, by_state: FloatArray, own: FloatArray
    ) -> None:
        """Add a point whose error is `by_state` (3, D) times that of the state, and an own one of covariance `own`."""
        cross = by_state @ self.covariance
        corner = cross @ by_state.T + own
        self.covariance = np.block([[self.covariance, cross.T], [cross, (corner + corner.T) / 2]])
        self.keys = np.append(self.keys, key)
        self.points = np.vstack([self.points, position])
        self.first_points = np.vstack([self.first_points, position])

    def correct(self, error: FloatArray) -> None:
        """Move the estimates by an error (D,)."""
        turn = so3_exp(error[TURN])
        self.R = turn @ self.R
        self.p = turn @ self.p + error[PLACE]
        self.v = turn @ self.v + error[VELOCITY]
        self.gyro_bias = self.gyro_bias + error[GYRO_BIAS]
        self.accel_bias = self.accel_bias + error[ACCEL_BIAS]
        at = self.first_point_column
        clones = error[NUM_INERTIAL:at].reshape(-1, 6)
        turns = so3_exp(clones[:, :3])
        self.clone_R = turns @ self.clone_R
        self.clone_p = (turns @ self.clone_p[..., None])[..., 0] + clones[:, 3:]
        self.points = self.points + error[at:].reshape(-1, 3)


def update(
    state: FilterState, columns: IntArray, H: FloatArray, residuals: FloatArray
) -> FloatArray:
    """Take measurements in and return by how much the state moved (D,).

    Args:
        state: Changed.
        columns: (J,) of the state, those that H has.
        H: (M, J) how the measurements follow the state's errors, in units of their sigmas.
        residuals: (M,) what was measured less what was expected, in the same units.
    """
    P = state.covariance
    cross = P[:, columns] @ H.T  # (D, M)
    S = H @ cross[columns] + np.eye(len(H))
    factor = np.linalg.inv(np.linalg.cholesky((S + S.T) / 2))
    half = cross @ factor.T
    error = half @ (factor @ residuals)
    P = P - half @ half.T
    state.covariance = (P + P.T) / 2
    state.correct(error)
    return error


def compressed(information: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return H (J, J) and residuals (J,) that say what H^T H and H^T r of many more rows say.

    What the rows leave open gets a share of 1e-11 of what they say, far below any prior, so that the factor exists.
    """
    share = 1e-11 * np.diagonal(information) + 1e-9
    factor = np.linalg.cholesky(information + np.diag(share))
    return np.asarray(factor.T), np.asarray(np.linalg.solve(factor, vector))
