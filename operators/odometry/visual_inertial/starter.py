"""Holds n-frames until the filter can start from them: at rest, or in motion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.visual.rays import Rays
from mapstream.operators.odometry.visual.sightings import Sightings
from mapstream.operators.odometry.visual_inertial.integration import Integration
from mapstream.operators.odometry.visual_inertial.moving_start import start_in_motion
from mapstream.operators.odometry.visual_inertial.resting_start import Held, start_at_rest
from mapstream.operators.odometry.visual_inertial.samples import ImuSamples
from mapstream.operators.odometry.visual_inertial.state import FilterState

_NUM_IMAGES = 10  # that a start in motion looks at
_LEAST_S, _EVERY_S = 1.0, 0.25  # of motion before the first try, and between tries


class Starter:
    """Collects n-frames.

    Args:
        imu: Noise of the IMU.
        window_s: So much is held at most; older n-frames are dropped.
    """

    def __init__(self, imu: ImuQuality, window_s: float) -> None:
        self._imu = imu
        self._window_ns = round(window_s * 1e9)
        self._next_try_ns: int | None = None
        self.held: list[Held] = []
        self.num_dropped = 0

    def add(self, stamp_ns: int, rays: Rays, samples: ImuSamples) -> FilterState | None:
        """Hold an n-frame that the samples cover; return the state at the first one held, once it is known."""
        if self.held and samples.between(self.held[-1].stamp_ns, stamp_ns).is_gap.any():
            self._drop(len(self.held))
        self.held.append(Held(stamp_ns, rays))
        old = sum(each.stamp_ns < stamp_ns - self._window_ns for each in self.held)
        self._drop(old)
        if len(self.held) < 2:
            return None
        motion = samples.between(self.held[0].stamp_ns, stamp_ns)
        at_rest = start_at_rest(self.held, motion, self._imu)
        if at_rest is not None or not self._is_time(stamp_ns):
            return at_rest
        return self._in_motion(samples)

    def _is_time(self, stamp_ns: int) -> bool:
        first_ns = self.held[0].stamp_ns + round(_LEAST_S * 1e9)
        if stamp_ns < max(first_ns, self._next_try_ns or first_ns):
            return False
        self._next_try_ns = stamp_ns + round(_EVERY_S * 1e9)
        return True

    def _in_motion(self, samples: ImuSamples) -> FilterState | None:
        count = min(_NUM_IMAGES, len(self.held))
        chosen = [
            self.held[k] for k in np.linspace(0, len(self.held) - 1, count).round().astype(int)
        ]
        T_imu_base = samples.T_base_imu.inverse().matrix
        sightings = Sightings.none()
        for number, each in enumerate(chosen):
            sightings = sightings.joined(Sightings.of(each.rays, number, T_imu_base))
        stamps = [each.stamp_ns for each in chosen]
        motions = [samples.between(a, b) for a, b in pairwise(stamps)]
        return start_in_motion(sightings, Integration(motions), self._imu, stamps[0])

    def _drop(self, count: int) -> None:
        del self.held[:count]
        self.num_dropped += count
