"""The IMU's samples as far as they are needed, and what lies between two stamps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import ImuBatch

_GAP_PERIODS = 3.5  # so many sample periods without a sample are a gap


class ImuSamples:
    """Samples in order of time; those that come late, or twice, are left out."""

    def __init__(self, imu: ImuQuality) -> None:
        self._imu = imu
        self._stamps_ns: IntArray = np.empty(0, np.int64)
        self._values: FloatArray = np.empty((0, 6))
        self._is_saturated: npt.NDArray[np.bool_] = np.empty(0, bool)
        self._period_ns = 0.0
        self.T_base_imu = SE3.identity()

    @property
    def is_empty(self) -> bool:
        return len(self._stamps_ns) == 0

    @property
    def start_ns(self) -> int:
        return int(self._stamps_ns[0])

    @property
    def end_ns(self) -> int:
        return -(2**62) if self.is_empty else int(self._stamps_ns[-1])

    def add(self, batch: ImuBatch) -> None:
        newest = np.maximum.accumulate(np.append(self.end_ns, batch.stamps_ns))
        fresh = batch.stamps_ns > newest[:-1]
        values = np.hstack([batch.gyro_radps, batch.accel_mps2])
        fresh &= np.isfinite(values).all(axis=1)
        self._stamps_ns = np.concatenate([self._stamps_ns, batch.stamps_ns[fresh]])
        self._values = np.concatenate([self._values, values[fresh]])
        saturated = self._imu.is_saturated(batch.gyro_radps, batch.accel_mps2)
        if batch.is_saturated is not None:
            saturated |= batch.is_saturated
        self._is_saturated = np.concatenate([self._is_saturated, saturated[fresh]])
        self.T_base_imu = batch.T_base_sensor
        if len(self._stamps_ns) > 1:
            self._period_ns = float(np.median(np.diff(self._stamps_ns[-400:])))

    def forget(self, before_ns: int) -> None:
        """Drop what is not needed from a stamp on; the last sample before it is."""
        first = max(0, int(np.searchsorted(self._stamps_ns, before_ns, side="right")) - 1)
        self._stamps_ns, self._values = self._stamps_ns[first:], self._values[first:]
        self._is_saturated = self._is_saturated[first:]

    def batch(self, start_ns: int, end_ns: int) -> ImuBatch:
        """Return the samples that enclose two stamps, as far as there are such."""
        first = max(0, int(np.searchsorted(self._stamps_ns, start_ns, side="right")) - 1)
        last = int(np.searchsorted(self._stamps_ns, end_ns, side="left")) + 1
        values = self._values[first:last]
        return ImuBatch(
            stamps_ns=self._stamps_ns[first:last],
            gyro_radps=values[:, :3],
            accel_mps2=values[:, 3:],
        )

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """Return what was measured between two stamps; beyond the samples the nearest one stands.

        Steps at a saturated sample count as not measured.
        """
        stamps, values = self._stamps_ns, self._values
        inside = (stamps > start_ns) & (stamps < end_ns)
        knots = np.concatenate([[start_ns], stamps[inside], [end_ns]])
        since, at = (stamps - start_ns) / 1e9, (knots - start_ns) / 1e9
        filled = np.column_stack([np.interp(at, since, values[:, k]) for k in range(6)])
        before = np.searchsorted(stamps, knots[:-1], side="right") - 1
        after = np.searchsorted(stamps, knots[1:], side="left")
        is_outside = (before < 0) | (after >= len(stamps))
        before, after = np.maximum(before, 0), np.minimum(after, len(stamps) - 1)
        spans = stamps[after] - stamps[before]
        reach = np.where(is_outside, np.diff(knots) + spans, spans)
        is_gap = reach > _GAP_PERIODS * self._period_ns
        is_gap |= self._is_saturated[before] | self._is_saturated[after]
        return Motion(knots, filled[:, :3], filled[:, 3:], is_gap)
