"""A motion that can be asked for its pose, turn rate and specific force at any time."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, so3_log

GRAVITY_MPS2 = 9.81
_DEGREE = 5  # acceleration and its first two derivatives are continuous
_STEP_NS = 1_000_000  # of the differences that give rates: truncation below 1e-5 m/s^2


class Motion:
    """Quintic splines through positions and roll, pitch, yaw."""

    def __init__(self, stamps_ns: IntArray, positions: FloatArray, rpy_rad: FloatArray) -> None:
        """Interpolate positions (N, 3) [m] and unwrapped angles (N, 3) at stamps (N,)."""
        from scipy.interpolate import make_interp_spline  # noqa: PLC0415  # 0.7 s to import

        self.start_ns, self.end_ns = int(stamps_ns[0]), int(stamps_ns[-1])
        values = np.concatenate([positions, rpy_rad], axis=1)
        self._spline = make_interp_spline((stamps_ns - self.start_ns) / 1e9, values, k=_DEGREE)

    def poses(self, stamps_ns: IntArray) -> FloatArray:
        """Return T_world_base (N, 4, 4).

        Raises:
            ValueError: If a stamp lies outside the motion.
        """
        if (
            stamps_ns.size
            and not self.start_ns <= stamps_ns.min() <= stamps_ns.max() <= self.end_ns
        ):
            span = f"{stamps_ns.min()} to {stamps_ns.max()}"
            raise ValueError(f"{span} lies outside the motion, {self.start_ns} to {self.end_ns}")
        return self._poses(stamps_ns)

    def _poses(self, stamps_ns: IntArray) -> FloatArray:
        values = self._spline((stamps_ns - self.start_ns) / 1e9)
        T = np.zeros((len(stamps_ns), 4, 4))
        T[:, :3, :3] = _rotations(values[:, 3:])
        T[:, :3, 3] = values[:, :3]
        T[:, 3, 3] = 1
        return T

    def velocities(self, stamps_ns: IntArray) -> FloatArray:
        """Return velocities of the base (N, 3) [m/s] in the world frame."""
        velocities: FloatArray = self._spline((stamps_ns - self.start_ns) / 1e9, nu=1)[:, :3]
        return velocities

    def angular_velocity(self, stamps_ns: IntArray) -> FloatArray:
        """Return turn rates (N, 3) [rad/s] in the base frame."""
        before, after = self._poses(stamps_ns - _STEP_NS), self._poses(stamps_ns + _STEP_NS)
        R_before_after = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
        rates: FloatArray = so3_log(R_before_after) / (2e-9 * _STEP_NS)
        return rates

    def specific_force(self, stamps_ns: IntArray, T_base_sensor: SE3) -> FloatArray:
        """Return what an ideal accelerometer at T_base_sensor reads, (N, 3) [m/s^2]."""
        before, now, after = (
            self._poses(stamps_ns + step) @ T_base_sensor.matrix
            for step in (-_STEP_NS, 0, _STEP_NS)
        )
        acceleration = (before + after - 2 * now)[:, :3, 3] / (1e-9 * _STEP_NS) ** 2
        acceleration[:, 2] += GRAVITY_MPS2
        R_sensor_world = np.swapaxes(now[:, :3, :3], 1, 2)
        forces: FloatArray = (R_sensor_world @ acceleration[:, :, None])[:, :, 0]
        return forces


def _rotations(rpy_rad: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) that roll first, then pitch, then yaw, about fixed axes."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad).T, np.sin(rpy_rad).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
