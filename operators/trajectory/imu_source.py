"""An IMU as a source of motion: its samples between two poses, and where they lead from a known state."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.join import END
from mapstream.streams.messages.sensors import ImuBatch


@dataclass(frozen=True, slots=True, eq=False)
class InertialState:
    """Where the base is and how fast, in a frame with z up."""

    T_odom_base: SE3
    velocity_mps: FloatArray  # (3,)


class ImuSource:
    """Samples of the last while.

    They are not a relative pose: what they say depends on attitude and velocity, which the optimizer finds.
    So an edge of kind `imu` carries the samples, and `propagate` gives no more than a first guess.
    """

    def __init__(
        self,
        *,
        gravity_mps2: float = 9.81,
        keep_ns: int = 30_000_000_000,
        max_gap_ns: int = 100_000_000,
    ) -> None:
        self._gravity = np.array([0.0, 0.0, -gravity_mps2])
        self._keep_ns = keep_ns
        self._max_gap_ns = max_gap_ns
        self._batches: deque[ImuBatch] = deque()

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The stamps of the oldest and the newest sample that are kept."""
        if not self._batches:
            return None
        return int(self._batches[0].stamps_ns[0]), int(self._batches[-1].stamps_ns[-1])

    @property
    def T_base_sensor(self) -> SE3:
        return self._batches[-1].T_base_sensor if self._batches else SE3.identity()

    def add(self, batch: ImuBatch) -> int:
        """Take the next samples in, and forget those that are too old; return how many came too late."""
        newest_ns = self._batches[-1].stamp_ns if self._batches else batch.stamps_ns[0] - 1
        is_new = batch.stamps_ns > newest_ns
        is_new[1:] &= np.diff(batch.stamps_ns) > 0
        if is_new.any():
            self._batches.append(batch if is_new.all() else _samples(batch, is_new))
        while self._batches[0].stamp_ns < self._batches[-1].stamp_ns - self._keep_ns:
            self._batches.popleft()
        return int((~is_new).sum())

    def measures(self, start_ns: int, end_ns: int) -> bool:
        """Return whether samples without a gap enclose the interval."""
        span = self.span_ns
        if span is None or not span[0] <= start_ns < end_ns <= span[1]:
            return False
        samples = self.samples(start_ns, end_ns)
        return bool(np.diff(samples.stamps_ns).max(initial=0) <= self._max_gap_ns)

    def is_decided(self, stamp_ns: int, known_ns: int) -> bool:
        """Return whether no sample can still change the answer up to a stamp."""
        span = self.span_ns
        if span is None:
            return known_ns >= stamp_ns
        return stamp_ns <= span[1] or known_ns > span[1] + self._max_gap_ns or known_ns >= END

    def samples(self, start_ns: int, end_ns: int) -> ImuBatch:
        """Return the samples that enclose an interval: from the last one up to its start to the first one at its end."""
        touched = [
            b for b in self._batches if b.stamp_ns >= start_ns - self._max_gap_ns
        ]  # the batch before may hold the sample before the start
        stamps_ns = np.concatenate([b.stamps_ns for b in touched])
        first = max(int(np.searchsorted(stamps_ns, start_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps_ns, end_ns, side="left"))
        kept = slice(first, last + 1)
        return ImuBatch(
            stamps_ns=stamps_ns[kept],
            gyro_radps=np.concatenate([b.gyro_radps for b in touched])[kept],
            accel_mps2=np.concatenate([b.accel_mps2 for b in touched])[kept],
            frame=touched[-1].frame,
            T_base_sensor=touched[-1].T_base_sensor,
        )

    def level_attitude(self, start_ns: int, end_ns: int) -> SE3:
        """Return T_odom_base with the mean force of an interval pointing up, and no yaw.

        It is right for a robot at rest or at constant speed; otherwise the optimizer finds the rest.
        """
        samples = self.samples(start_ns, end_ns)
        up_base = samples.T_base_sensor.R @ samples.accel_mps2.mean(axis=0)
        up_base = up_base / np.linalg.norm(up_base)
        axis = np.cross(up_base, [0.0, 0.0, 1.0])
        sine = float(np.linalg.norm(axis))
        angle = float(np.arctan2(sine, up_base[2]))
        direction = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
        return SE3.from_rotation(so3_exp(angle * direction))

    def propagate(self, state: InertialState, start_ns: int, end_ns: int) -> InertialState:
        """Return the state at the end of an interval, by integrating the samples, without biases.

        The lever arm between base and IMU is left out: this is a first guess.
        """
        samples = self.samples(start_ns, end_ns)
        R_base_imu = samples.T_base_sensor.R
        times_ns = np.clip(samples.stamps_ns, start_ns, end_ns)
        steps_s = np.diff(times_ns) / 1e9
        turns = samples.gyro_radps[1:] @ R_base_imu.T * steps_s[:, None]
        whole, half = so3_exp(turns), so3_exp(turns / 2)
        forces = (samples.accel_mps2[1:] + samples.accel_mps2[:-1]) / 2 @ R_base_imu.T
        R, t, v = state.T_odom_base.R, state.T_odom_base.t, state.velocity_mps
        for k, dt in enumerate(steps_s.tolist()):
            acceleration = R @ (half[k] @ forces[k]) + self._gravity
            t = t + v * dt + acceleration * dt**2 / 2
            v = v + acceleration * dt
            R = R @ whole[k]
        return InertialState(SE3.from_rotation(R, t), v)


def _samples(batch: ImuBatch, kept: npt.NDArray[np.bool_]) -> ImuBatch:
    return ImuBatch(
        stamps_ns=batch.stamps_ns[kept],
        gyro_radps=batch.gyro_radps[kept],
        accel_mps2=batch.accel_mps2[kept],
        frame=batch.frame,
        T_base_sensor=batch.T_base_sensor,
    )
