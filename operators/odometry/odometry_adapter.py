"""Odometry of another program, made that of the base: ROVIO, OKVIS, FAST-LIO2 and whatever comes."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import field_validator

from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.sync import anchored, latest


class OdometryAdapterConfig(OperatorConfig):
    """Options of `odometry_adapter`."""

    velocity: Literal["base", "odom", "ignore"] = "base"
    """The frame of recorded twists: the base's, as ROS has it; the odometry's; or not to be trusted."""
    T_base_sensor: tuple[float, float, float, float, float, float, float] = (0, 0, 0, 0, 0, 0, 1)
    """Where the sensor sits whose poses these are: x y z [m], qx qy qz qw."""

    @field_validator("T_base_sensor")
    @classmethod
    def _check_rotation(cls, numbers: tuple[float, ...]) -> tuple[float, ...]:
        if not any(numbers[3:]):
            raise ValueError("the quaternion has no length; the identity is 0 0 0 1")
        return numbers


@dataclass(frozen=True)
class Inputs:
    """Odometry, and the IMU biases beside it, as gyroscope and accelerometer of an IMU message (ROVIO)."""

    odometry: Receiver[Odometry]
    biases: Receiver[ImuBatch] | None


@dataclass(frozen=True)
class Outputs:
    """The same moments."""

    odometry: Sender[Odometry]


class OdometryAdapter(Operator[Inputs, Outputs]):
    """Make the poses of a sensor those of the base, and give them the biases that came beside.

    The newest biases before a pose are its biases. Where the sensor sits away from the base, its velocity is
    not the base's, and is left out.
    """

    def __init__(self, config: OdometryAdapterConfig) -> None:
        self._velocity = config.velocity
        place = config.T_base_sensor
        self._T_base_sensor = SE3.from_quat_xyzw(place[3:], place[:3])
        self._is_away = bool(np.any(self._T_base_sensor.t))

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for odometry, biases in _with_biases(inputs):
            await outputs.odometry.send(self.adapted(odometry, biases))

    def adapted(self, odometry: Odometry, biases: ImuBatch | None) -> Odometry:
        """Return what the odometry says of the base."""
        T_odom_sensor, velocity = odometry.T_odom_base, odometry.velocity_mps
        if self._velocity == "ignore" or self._is_away:
            velocity = None
        elif self._velocity == "odom" and velocity is not None:
            velocity = T_odom_sensor.R.T @ velocity  # undo what the decoder did
        covariance = odometry.covariance
        if covariance is not None:
            carried = self._T_base_sensor.adjoint()  # a step's perturbation, seen from the base
            covariance = carried @ covariance @ carried.T
        adapted = replace(
            odometry,
            T_odom_base=T_odom_sensor @ self._T_base_sensor.inverse(),
            covariance=covariance,
            velocity_mps=velocity,
        )
        if biases is None:
            return adapted
        return replace(
            adapted, gyro_bias_radps=biases.gyro_radps[-1], accel_bias_mps2=biases.accel_mps2[-1]
        )


async def _with_biases(inputs: Inputs) -> AsyncIterator[tuple[Odometry, ImuBatch | None]]:
    if inputs.biases is None:
        async for odometry in inputs.odometry:
            yield odometry, None
        return
    async for odometry, biases in anchored(inputs.odometry, latest(inputs.biases, optional=True)):
        yield odometry, biases
