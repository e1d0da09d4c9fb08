"""Scans that wait until it is known how the robot began.

They are followed with velocity and gravity all but unknown. That shows whether the robot stands, which an IMU
cannot tell from even motion; if it does not, the poses and the samples say velocity and gravity.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.imu.samples import is_at_rest
from mapstream.operators.odometry.lidar_inertial.first_states import guessed, moving, resting
from mapstream.operators.odometry.lidar_inertial.state import LidarInertialState
from mapstream.operators.odometry.lidar_inertial.tracker import Tracker, TrackerLimits
from mapstream.operators.odometry.scan_motion import Sweep
from mapstream.operators.odometry.visual_inertial.samples import ImuSamples
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.sensors import ImuBatch

_REST_NS = 500_000_000  # so long a robot must stand
_REST_M = 0.03  # and no farther it may seem to have moved
_LEAST_POSES = 4
_NUM_GUESSES = 4  # of the velocity, by which the first scan is straightened


class Starter:
    """Holds scans, and finds the state at the end of the first."""

    def __init__(self, imu: ImuQuality, samples: ImuSamples, window_ns: int) -> None:
        self._imu = imu
        self._samples = samples
        self._window_ns = window_ns
        self._poses: list[FloatArray] = []  # T_odom_imu at the scans' ends
        self._follower: Tracker | None = None
        self.held: list[Sweep] = []

    def add(self, sweep: Sweep, limits: TrackerLimits) -> LidarInertialState | None:
        """Hold one more scan; return the state at the end of the first one if it can be known now."""
        self.held.append(sweep)
        if len(self.held) <= 2 or self._follower is None:
            self._begin(limits)
        else:
            self._follow(self._follower, sweep)
        elapsed_ns = sweep.end_ns - self.held[0].end_ns
        if elapsed_ns >= _REST_NS and self._stands():
            return resting(self._seen(), self.held[0].end_ns, self._imu)
        return self.last_state() if elapsed_ns >= self._window_ns else None

    def last_state(self) -> LidarInertialState | None:
        """Return the state that all scans so far say; None if they are too few."""
        if len(self.held) < _LEAST_POSES:
            return None
        stamps_ns = np.array([sweep.end_ns for sweep in self.held])
        return moving(stamps_ns, np.array(self._poses), self._seen(), self._imu)

    def _begin(self, limits: TrackerLimits) -> None:
        """Follow the first scans, each time with the velocity that came out of the time before."""
        first = self.held[0]
        velocity = np.zeros(3)
        for _ in range(_NUM_GUESSES if len(self.held) > 1 else 1):
            samples = self._samples.batch(first.start_ns, first.end_ns)
            state = guessed(samples, velocity, first.end_ns, self._imu)
            self._follower, self._poses = Tracker(state, self._samples, self._imu, limits), []
            for sweep in self.held:
                self._follow(self._follower, sweep)
            step_s = (self.held[-1].end_ns - first.end_ns) / 1e9
            moved = self._poses[0][:3, :3].T @ (self._poses[-1] - self._poses[0])[:3, 3]
            velocity = moved / max(step_s, 1e-3)

    def _follow(self, follower: Tracker, sweep: Sweep) -> None:
        follower.track(sweep)
        self._poses.append(follower.state.T_odom_imu.matrix)

    def _seen(self) -> ImuBatch:
        return self._samples.batch(self.held[0].start_ns, self.held[-1].end_ns)

    def _stands(self) -> bool:
        places = np.array(self._poses)[:, :3, 3]
        moved_m = np.linalg.norm(places - places[0], axis=1).max()
        return bool(moved_m < _REST_M) and is_at_rest(self._seen())
