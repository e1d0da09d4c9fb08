"""What is wrong with what an IMU or a LiDAR says, as far as the numbers alone tell."""

from __future__ import annotations

from typing import Final

import numpy as np

from mapstream.recordings.stamp_checks import Finding
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.sensors import LidarScan

GRAVITY_MPS2: Final = 9.81
_UNITS: Final = {1.0: "g", 981.0: "cm/s^2", 9810.0: "mm/s^2"}  # of an accelerometer at rest
_FAST_RADPS: Final = 8.0  # a robot's usual turn rate is below it; in degrees it is often above
_TOLERANCE: Final = 0.1


def check_imu(topic: str, accel: FloatArray, gyro: FloatArray) -> list[Finding]:
    """Check that gravity is there and in m/s^2, and say which way is up; (N, 3) each."""
    found: list[Finding] = []
    accel = accel[np.isfinite(accel).all(axis=1)]
    gyro = gyro[np.isfinite(gyro).all(axis=1)]
    if not len(accel) or not len(gyro):
        return [_warning(topic, "imu_not_finite", "no sample is finite")]
    norm = float(np.median(np.linalg.norm(accel, axis=1)))
    unit = next((u for g, u in _UNITS.items() if abs(norm / g - 1) < _TOLERANCE), None)
    if unit is not None:
        text = f"accelerations seem to be in {unit}: {norm:.4g} at rest instead of {GRAVITY_MPS2}"
        found.append(_warning(topic, "imu_units", text))
    elif abs(norm / GRAVITY_MPS2 - 1) > _TOLERANCE:
        text = f"the usual acceleration is {norm:.3f} m/s^2 instead of {GRAVITY_MPS2}"
        hint = "; gravity was taken out" if norm < 2 else ""
        found.append(_warning(topic, "imu_gravity", text + hint))
    up = np.median(accel, axis=0)
    axis = int(np.argmax(np.abs(up)))
    if norm > 0 and abs(up[axis]) / norm > 0.7:
        sign = "+" if up[axis] > 0 else "-"
        tilt_deg = float(np.degrees(np.arccos(np.clip(abs(up[axis]) / np.linalg.norm(up), -1, 1))))
        text = f"{sign}{'xyz'[axis]} points up, tilted by {tilt_deg:.1f} deg"
        found.append(Finding(name="imu_axes", topic=topic, text=text, severity="note"))
    rate = float(np.median(np.linalg.norm(gyro, axis=1)))
    if rate > _FAST_RADPS:
        text = f"the usual turn rate is {rate:.1f} rad/s; perhaps it is in degrees"
        found.append(_warning(topic, "imu_units", text))
    return found


class CloudChecks:
    """Gathers what is odd about the scans of one topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._num_scans = self._num_empty = self._num_timed = self._num_equal_times = 0
        self._num_intensity = self._num_ring = 0
        self._spans_ns: list[int] = []

    def add(self, scan: LidarScan) -> None:
        """Take note of one scan."""
        self._num_scans += 1
        self._num_intensity += scan.intensity is not None
        self._num_ring += scan.ring is not None
        if not len(scan.points):
            self._num_empty += 1
        elif scan.offsets_ns is not None:
            self._num_timed += 1
            span_ns = int(scan.offsets_ns.max() - scan.offsets_ns.min())
            self._num_equal_times += span_ns == 0 and len(scan.points) > 1
            self._spans_ns.append(span_ns)

    def findings(self, period_ns: float) -> list[Finding]:
        """Return what was found, given the usual time between two scans (nan: unknown)."""
        found = []
        missing = [
            name
            for name, count in (("intensity", self._num_intensity), ("ring", self._num_ring))
            if count == 0 and self._num_scans
        ]
        if missing:
            text = f"points carry no {' and no '.join(missing)}"
            found.append(
                Finding(name="cloud_fields", topic=self._topic, text=text, severity="note")
            )
        if self._num_empty:
            text = f"{self._num_empty} of {self._num_scans} clouds are empty"
            found.append(_warning(self._topic, "empty_clouds", text))
        return found + self._time_findings(period_ns)

    def _time_findings(self, period_ns: float) -> list[Finding]:
        if self._num_scans and not self._num_timed and self._num_empty < self._num_scans:
            text = "points carry no time, so scans cannot be deskewed"
            return [_warning(self._topic, "no_point_times", text)]
        if self._num_equal_times:
            text = f"{self._num_equal_times} of {self._num_timed} clouds give all points one time"
            return [_warning(self._topic, "equal_point_times", text)]
        if not self._spans_ns or not period_ns > 0:
            return []
        share = float(np.median(self._spans_ns)) / period_ns
        if 0.05 < share < 1.5:
            return []
        text = f"point times span {share * period_ns / 1e9:.6g} s of a period of {period_ns / 1e9:.3f} s"
        hint = "; perhaps they are in microseconds" if 0.5e-3 < share < 2e-3 else ""
        return [_warning(self._topic, "point_time_span", text + hint)]


def _warning(topic: str, name: str, text: str) -> Finding:
    return Finding(name=name, topic=topic, text=text)
