"""What an IMU begins with, for odometry that does not say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.imu.bias_estimate import ImuStart, PoseNoise, estimate_start
from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.imu.samples import cut, is_at_rest, joined, level_attitude
from mapstream.operators.operator import Operator, OperatorConfig, offload, warn
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch


class ImuBiasesConfig(OperatorConfig):
    """Options of `imu_biases`."""

    imu: ImuQuality = ImuQuality()
    """Its noise and its limits; where it sits is taken from its samples."""
    window_s: PositiveFloat = 5.0
    """How much of the recording is looked at, at least; it is held back so long."""
    max_window_s: PositiveFloat = 30.0
    """And at most, where the motion leaves the biases open."""
    step_s: PositiveFloat = 0.2
    """Between poses that are compared."""
    sigma_rad: PositiveFloat = 0.002
    """Uncertainty of the odometry over such a step."""
    sigma_m: PositiveFloat = 0.01
    """The same, of its translation."""
    max_gyro_sigma_radps: PositiveFloat = 0.005
    """The biases count as found when they are known so well."""
    max_accel_sigma_mps2: PositiveFloat = 0.02
    """The same, of the accelerometer."""


@dataclass(frozen=True)
class Inputs:
    """Samples, and the odometry that they belong to; without odometry the robot must stand still."""

    imu: Receiver[ImuBatch]
    odometry: Receiver[Odometry] | None


@dataclass(frozen=True)
class Outputs:
    """The odometry with biases, and at first with velocities; without an input, one pose at rest."""

    odometry: Sender[Odometry]


class ImuBiases(Operator[Inputs, Outputs]):
    """Find the biases of an IMU, and fill them into odometry that has none.

    In motion they follow from the odometry's poses. At rest the gyroscope's bias and that of the accelerometer
    along gravity do; across, a bias looks like a tilt, and is taken as zero.
    """

    def __init__(self, config: ImuBiasesConfig) -> None:
        self._config = config
        self._window_ns = round(config.window_s * 1e9)
        self._batches: list[ImuBatch] = []
        self._start: ImuStart | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.odometry is None:
            await self._stand_still(inputs.imu, outputs)
        else:
            await self._move(inputs.imu, inputs.odometry, outputs)

    async def _stand_still(self, imu: Receiver[ImuBatch], outputs: Outputs) -> None:
        async for batch in imu:
            if self._start is not None:
                outputs.odometry.advance(batch.stamp_ns)
                continue
            self._batches.append(batch)
            self._forget(batch.stamp_ns - self._window_ns)
            if batch.stamp_ns - self._batches[0].stamps_ns[0] < self._window_ns:
                continue
            samples = joined(self._batches)
            if is_at_rest(samples):
                await outputs.odometry.send(await offload(self.at_rest, samples))
        if self._start is None:
            seconds = self._config.window_s
            raise EstimationError(
                f"the IMU never stood still for {seconds:g} s; connect odometry, or set window_s lower"
            )

    async def _move(
        self, imu: Receiver[ImuBatch], odometry: Receiver[Odometry], outputs: Outputs
    ) -> None:
        held: list[Odometry] = []
        look_ns = 0  # when the window is long enough for another look
        async for message in odometry:
            await self._read_until(imu, message.stamp_ns)
            if self._start is not None:
                await outputs.odometry.send(self._with_biases(message))
                self._forget(message.stamp_ns)
                continue
            held.append(message)
            look_ns = look_ns or message.stamp_ns + self._window_ns
            if message.stamp_ns >= look_ns:
                look_ns = message.stamp_ns + self._window_ns // 2
                is_last = message.stamp_ns - held[0].stamp_ns >= self._config.max_window_s * 1e9
                for filled in await offload(self.looked_at, held, is_last):
                    await outputs.odometry.send(filled)
        is_last = True
        if self._start is None:
            for filled in await offload(self.looked_at, held, is_last):
                await outputs.odometry.send(filled)

    def at_rest(self, samples: ImuBatch) -> Odometry:
        """Return the pose at the end of samples at rest, upright, with biases."""
        first_ns, last_ns = int(samples.stamps_ns[0]), int(samples.stamps_ns[-1])
        stamps_ns = np.arange(first_ns, last_ns, round(self._config.step_s * 1e9))
        poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        start = estimate_start(stamps_ns, poses, samples, self._config.imu, PoseNoise(1e-4, 1e-3))
        self._settle(start)
        return Odometry(
            stamp_ns=last_ns,
            T_odom_base=SE3.from_rotation(level_attitude(start.up)),
            velocity_mps=np.zeros(3),
            gyro_bias_radps=start.gyro_bias_radps,
            accel_bias_mps2=start.accel_bias_mps2,
        )

    def looked_at(self, held: list[Odometry], is_last: bool) -> list[Odometry]:  # noqa: FBT001  # offloaded
        """Return the messages with biases and velocities if they are known now; none while they are not.

        Args:
            held: All messages so far.
            is_last: Whether no better occasion comes, so that what is known must do.
        """
        chosen, poses = self._poses(held)
        if len(chosen) < 3:
            if is_last:
                warn("the biases are not known: the IMU and the odometry have too little in common")
            return list(held) if is_last else []
        config = self._config
        noise = PoseNoise(config.sigma_rad, config.sigma_m)
        start = estimate_start(chosen, poses, joined(self._batches), config.imu, noise)
        is_good = start.gyro_sigma_radps < config.max_gyro_sigma_radps
        is_good &= start.accel_sigma_mps2 < config.max_accel_sigma_mps2
        if not (is_good or is_last):
            return []
        self._settle(start)
        return [self._with_velocity(message, chosen, start) for message in held]

    def _poses(self, held: list[Odometry]) -> tuple[IntArray, FloatArray]:
        """Return stamps and poses (N, 4, 4), a step apart, where there are samples and no step was lost."""
        chosen: list[Odometry] = []
        span = (
            (self._batches[0].stamps_ns[0], self._batches[-1].stamp_ns) if self._batches else (1, 0)
        )
        for message in held:
            if message.is_lost:
                chosen = []
            step_ns = message.stamp_ns - chosen[-1].stamp_ns if chosen else np.inf
            if span[0] <= message.stamp_ns <= span[1] and step_ns >= 0.99e9 * self._config.step_s:
                chosen.append(message)
        stamps = np.array([message.stamp_ns for message in chosen], dtype=np.int64)
        poses = [message.T_odom_base.matrix for message in chosen]
        return stamps, np.array(poses).reshape(-1, 4, 4)

    def _settle(self, start: ImuStart) -> None:
        self._start = start
        config = self._config
        if start.gyro_sigma_radps > config.max_gyro_sigma_radps:
            warn(f"the gyroscope's bias is known to {start.gyro_sigma_radps:.2g} rad/s only")
        if start.accel_sigma_mps2 > config.max_accel_sigma_mps2:
            warn(
                "the accelerometer's bias is known in some directions only: the motion does not tell it"
                " from a tilt"
            )

    def _with_biases(self, message: Odometry) -> Odometry:
        if self._start is None or message.gyro_bias_radps is not None:
            return message
        return replace(
            message,
            gyro_bias_radps=self._start.gyro_bias_radps,
            accel_bias_mps2=self._start.accel_bias_mps2,
        )

    def _with_velocity(self, message: Odometry, stamps_ns: IntArray, start: ImuStart) -> Odometry:
        """Return the message with biases, and the velocity if it lies among the poses that were compared."""
        filled = self._with_biases(message)
        if (
            message.velocity_mps is not None
            or not stamps_ns[0] <= message.stamp_ns <= stamps_ns[-1]
        ):
            return filled
        at, since = message.stamp_ns - stamps_ns[0], stamps_ns - stamps_ns[0]
        velocity = [np.interp(at, since, start.velocity_mps[:, axis]) for axis in range(3)]
        return replace(filled, velocity_mps=np.array(velocity))

    async def _read_until(self, imu: Receiver[ImuBatch], stamp_ns: int) -> None:
        while not self._batches or self._batches[-1].stamp_ns < stamp_ns:
            batch = await anext(imu, None)
            if batch is None:
                return
            self._batches.append(batch)

    def _forget(self, before_ns: int) -> None:
        """Drop samples before a stamp; a batch that reaches over it is cut."""
        kept = [cut(b, before_ns) for b in self._batches[:-1] if b.stamp_ns >= before_ns]
        self._batches = [*kept, *self._batches[-1:]]
