"""First guesses of the poses of a trajectory, each from the one before it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mapstream.operators.odometry.continuous import Motion
from mapstream.operators.trajectory.imu_source import ImuSource, InertialState
from mapstream.operators.trajectory.sources import PoseSource
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry

LEVELLING_NS = 500_000_000  # of the IMU's samples behind the first pose say where up is


class DeadReckoning:
    """States by stamp, in one frame in which motion goes on whichever source measured it.

    It begins where the first source says; an IMU turns it so that z points up.
    """

    def __init__(self, sources: Mapping[str, PoseSource], imu: ImuSource | None) -> None:
        self._sources = sources
        self._imu = imu
        self._states: dict[int, Odometry] = {}

    def at(self, stamp_ns: int) -> Odometry:
        return self._states[stamp_ns]

    def begin(self, stamp_ns: int) -> Odometry:
        """Begin with the pose at a stamp."""
        state = next((s for s in self._asked(stamp_ns)), None)
        if state is None:
            state = Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity())
        T_odom_base = state.T_odom_base
        if self._imu is not None and self._imu.measures(stamp_ns, stamp_ns + 1):
            forward = T_odom_base.R[:, 0]
            yaw = so3_exp([0.0, 0.0, np.arctan2(forward[1], forward[0])])
            level = self._imu.level_attitude(stamp_ns, stamp_ns + LEVELLING_NS)
            T_odom_base = SE3.from_rotation(yaw @ level.R, T_odom_base.t)
        self._states[stamp_ns] = self._described(stamp_ns, T_odom_base)
        return self._states[stamp_ns]

    def go_on(self, start_ns: int, end_ns: int, motion: Motion | None) -> Odometry:
        """Go from a known pose to the next one; without a motion the IMU is integrated."""
        self._states[end_ns] = self.reached(start_ns, end_ns, motion)
        return self._states[end_ns]

    def go_back(self, start_ns: int, end_ns: int, motion: Motion | None) -> Odometry:
        """Add a pose before the first one, from which a motion leads to it."""
        T_start_end = SE3.identity() if motion is None else motion.T_start_end
        T_odom_base = self._states[end_ns].T_odom_base @ T_start_end.inverse()
        self._states[start_ns] = self._described(start_ns, T_odom_base)
        return self._states[start_ns]

    def reached(self, start_ns: int, end_ns: int, motion: Motion | None) -> Odometry:
        """Return the state after a motion from a known pose.

        Raises:
            EstimationError: If neither a motion nor the IMU leads there.
        """
        start = self._states[start_ns]
        if motion is not None:
            return self._described(end_ns, start.T_odom_base @ motion.T_start_end)
        if self._imu is None:
            raise EstimationError(f"nothing leads from {start_ns} to {end_ns} ns")
        velocity = np.zeros(3) if start.velocity_mps is None else start.velocity_mps
        known = InertialState(start.T_odom_base, velocity)
        state = self._imu.propagate(known, start_ns, end_ns)
        return Odometry(
            stamp_ns=end_ns, T_odom_base=state.T_odom_base, velocity_mps=state.velocity_mps
        )

    def forget_before(self, stamp_ns: int) -> None:
        for old in [known for known in self._states if known < stamp_ns]:
            del self._states[old]

    def _described(self, stamp_ns: int, T_odom_base: SE3) -> Odometry:
        """Return the pose with velocity and biases, where a source knows them, turned into this frame."""
        for state in self._asked(stamp_ns):
            if state.velocity_mps is None and state.gyro_bias_radps is None:
                continue
            velocity = state.velocity_mps
            if velocity is not None:
                velocity = T_odom_base.R @ state.T_odom_base.R.T @ velocity
            return replace(state, T_odom_base=T_odom_base, velocity_mps=velocity)
        return Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base)

    def _asked(self, stamp_ns: int) -> list[Odometry]:
        """Return what the sources that know the stamp say of it."""
        return [
            source.state_at(stamp_ns)
            for source in self._sources.values()
            if source.measures(stamp_ns, stamp_ns)
        ]
