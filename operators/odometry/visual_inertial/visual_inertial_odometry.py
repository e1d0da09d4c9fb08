"""Odometry from tracked keypoints of any number of cameras, and an IMU."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat

from mapstream.operators.odometry.uncertainty import unmeasured
from mapstream.operators.odometry.visual.rays import Rays, rays_of
from mapstream.operators.odometry.visual_inertial.filter import Filter, FilterLimits, Step
from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.operators.odometry.visual_inertial.resting_start import place
from mapstream.operators.odometry.visual_inertial.samples import ImuSamples
from mapstream.operators.odometry.visual_inertial.starter import Starter
from mapstream.operators.odometry.visual_inertial.state import FilterState
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.trajectory.config import ImuConfig
from mapstream.operators.trajectory.rig_imu import described
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3, straightened
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import NFrame

_LEAST_FOLLOWED = 5  # tracks, with fewer an image measures no motion
_MOST_REFUSED = 0.8  # of the tracks, beyond which the filter is not believed


class VisualInertialOdometryConfig(OperatorConfig):
    """Options of `visual_inertial_odometry`."""

    imu: ImuConfig = ImuConfig()
    """Its noise and its limits; where it sits is taken from its samples."""
    sigma_px: PositiveFloat = 1.0
    """Of keypoints that do not say."""
    num_clones: int = Field(default=11, ge=4, le=40)
    """So many images are in the window."""
    num_points: NonNegativeInt = 40
    """So many points that are tracked for longer are part of the state."""
    num_tracks: int = Field(default=60, ge=1)
    """So many tracks that end at an image are used at most."""
    start_window_s: PositiveFloat = 2.5
    """The start looks back so far at most."""
    max_lost_s: PositiveFloat = 5.0
    """After so long without images, or with images that contradict the motion, it starts anew."""


@dataclass(frozen=True)
class Inputs:
    """Keypoints with tracks; samples that cover them."""

    n_frames: Receiver[NFrame]
    imu: Receiver[ImuBatch]


@dataclass(frozen=True)
class Outputs:
    """One per n-frame from the start on, with velocity and biases; z is up."""

    odometry: Sender[Odometry]


class VisualInertialOdometry(Operator[Inputs, Outputs]):
    """Estimate the motion of a robot from tracks and an IMU: a multi-state constraint Kalman filter.

    It starts where the robot stands for half a second, or as soon as motion and tracks show gravity, velocity
    and scale; the n-frames until then are held, and estimated afterwards. The odom frame is the
    base at the first of them, made level. An n-frame in which too few tracks go on is predicted by the IMU
    and says so (`is_lost`). Gaps in the IMU are bridged by the images.
    """

    placement: ClassVar[Placement] = "process"  # numpy on small matrices holds the GIL

    def __init__(self, config: VisualInertialOdometryConfig) -> None:
        self._config = config
        self._imu = described(config.imu)
        self._limits = FilterLimits(config.num_clones, config.num_points, config.num_tracks)
        self._samples = ImuSamples(self._imu)
        self._starter = Starter(self._imu, config.start_window_s)
        self._filter: Filter | None = None
        self._last_ns: int | None = None  # of the last n-frame
        self._before_ns = 0  # where the filter is
        self._good_ns = 0  # of the last n-frame that was measured
        self._left: tuple[int, SE3] | None = None  # where a filter was given up

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for frame in inputs.n_frames:
            await self._read_until(inputs.imu, frame.stamp_ns)
            for odometry in await offload(self.track, frame):
                await outputs.odometry.send(odometry)
        if self._filter is None:
            num = len(self._starter.held) + self._starter.num_dropped
            if num:
                warn(f"{num} n-frames gave no start: neither at rest, nor enough tracks in motion")

    def add_imu(self, batch: ImuBatch) -> None:
        """Take samples, before the n-frames that they cover."""
        self._samples.add(batch)

    def track(self, frame: NFrame) -> list[Odometry]:
        """Return the odometry at an n-frame, and at those before it that were held."""
        stamp_ns = frame.stamp_ns
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            warn("n-frames whose stamp does not increase were left out")
            return []
        if self._samples.is_empty or stamp_ns < self._samples.start_ns:
            warn("n-frames before the first sample of the IMU were left out")
            return []
        self._last_ns = stamp_ns
        rays = rays_of(frame, self._config.sigma_px)
        if self._filter is not None:
            return [self._step(self._filter, stamp_ns, rays)]
        state = self._starter.add(stamp_ns, rays, self._samples)
        if state is None:
            self._samples.forget(self._starter.held[0].stamp_ns)
            return []
        return self._started(state)

    def _started(self, state: FilterState) -> list[Odometry]:
        """Return the odometry at the n-frames that were held, now that the first state is known."""
        held = self._starter.held
        if self._starter.num_dropped:
            warn(f"{self._starter.num_dropped} n-frames passed before the start")
        left = self._left
        where = SE3.identity() if left is None else left[1]
        place(state, where, self._samples.T_base_imu.inverse())
        self._starter = Starter(self._imu, self._config.start_window_s)
        self._filter = Filter(state, self._imu, self._samples.T_base_imu, self._limits)
        self._before_ns = self._good_ns = held[0].stamp_ns
        first = self._step(self._filter, held[0].stamp_ns, held[0].rays)
        if left is None:
            first = replace(first, covariance=None)
        else:
            duration_s = (held[0].stamp_ns - left[0]) / 1e9
            first = replace(first, covariance=unmeasured(duration_s), is_lost=True)
        rest = [self._step(self._filter, each.stamp_ns, each.rays) for each in held[1:]]
        return [first, *rest]

    def _step(self, estimator: Filter, stamp_ns: int, rays: Rays) -> Odometry:
        motion = self._samples.between(self._before_ns, stamp_ns)
        if motion.is_gap.any():
            warn("the IMU has gaps; between n-frames they are bridged by the images")
        step = estimator.step(rays, motion)
        self._samples.forget(stamp_ns)
        self._before_ns = stamp_ns
        is_first = int(motion.stamps_ns[-1]) == int(motion.stamps_ns[0])
        is_lost = not (is_first or self._is_measured(step))
        if is_lost:
            warn("n-frames with too few tracks; the IMU alone says the motion there")
        else:
            self._good_ns = stamp_ns
        odometry = self._odometry(estimator.state, motion, step, is_lost=is_lost)
        if stamp_ns - self._good_ns > self._config.max_lost_s * 1e9:
            warn("the images were lost for too long; the odometry starts anew where it was")
            self._left, self._filter = (stamp_ns, odometry.T_odom_base), None
        return odometry

    def _is_measured(self, step: Step) -> bool:
        judged = step.num_used + step.num_refused
        contradicts = judged >= _LEAST_FOLLOWED and step.num_refused > _MOST_REFUSED * judged
        return step.is_standing or (step.num_followed >= _LEAST_FOLLOWED and not contradicts)

    def _odometry(
        self, state: FilterState, motion: Motion, step: Step, *, is_lost: bool
    ) -> Odometry:
        """Return what the state says of the base."""
        T_base_imu = self._samples.T_base_imu
        adjoint = T_base_imu.adjoint()
        T_imu_base = T_base_imu.inverse()
        rate = motion.gyro[-1] - state.gyro_bias
        return Odometry(
            stamp_ns=state.stamp_ns,
            T_odom_base=SE3(straightened((state.T_odom_imu @ T_imu_base).matrix)),
            covariance=adjoint @ step.covariance @ adjoint.T,
            velocity_mps=state.v + state.R @ np.cross(rate, T_imu_base.t),
            gyro_bias_radps=state.gyro_bias,
            accel_bias_mps2=state.accel_bias,
            is_lost=is_lost,
        )

    async def _read_until(self, imu: Receiver[ImuBatch], stamp_ns: int) -> None:
        while self._samples.end_ns < stamp_ns:
            batch = await anext(imu, None)
            if batch is None:
                return
            self.add_imu(batch)
