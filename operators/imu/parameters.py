"""How good an IMU is and where it sits: what turns its samples into factors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.sensors import ImuSensor

_Seven = Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]


class ImuQuality(OperatorConfig):
    """How good an IMU is; the defaults are those of a MEMS of middling quality."""

    gyro_density: PositiveFloat = 1e-3
    """White noise of the gyroscope [rad/s/sqrt(Hz)]."""
    accel_density: PositiveFloat = 1e-2
    """White noise of the accelerometer [m/s^2/sqrt(Hz)]."""
    gyro_random_walk: PositiveFloat = 1e-5
    """Of the gyroscope's bias [rad/s^2/sqrt(Hz)]."""
    accel_random_walk: PositiveFloat = 1e-4
    """Of the accelerometer's bias [m/s^3/sqrt(Hz)]."""
    gravity_mps2: PositiveFloat = 9.81
    max_gyro_radps: PositiveFloat | None = None
    """Samples that reach it are saturated and hardly count."""
    max_accel_mps2: PositiveFloat | None = None
    """The same, of the specific force."""
    gyro_bias_sigma_radps: PositiveFloat = 0.1
    """How far from zero the bias may begin."""
    accel_bias_sigma_mps2: PositiveFloat = 0.5
    """The same, of the accelerometer."""

    def is_saturated(self, gyro_radps: FloatArray, accel_mps2: FloatArray) -> BoolArray:
        """Return which samples (N,) reach a limit in some axis of gyro (N, 3) and accel (N, 3)."""
        gyro_limit = self.max_gyro_radps or np.inf
        accel_limit = self.max_accel_mps2 or np.inf
        over_gyro = (np.abs(gyro_radps) >= gyro_limit).any(axis=1)
        over_accel = (np.abs(accel_mps2) >= accel_limit).any(axis=1)
        return np.asarray(over_gyro | over_accel)


class ImuParameters(ImuQuality):
    """All that turns samples into factors; a map's mission keeps it among its sensors, under `imu`."""

    T_base_sensor: _Seven = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Where it sits: x, y, z [m] and the quaternion x, y, z, w."""

    @classmethod
    def from_description(cls, description: Mapping[str, Any]) -> ImuParameters:
        """Return the parameters in a mission's description of its "imu"; what it lacks has its default.

        Raises:
            ValidationError: If a value is not one.
        """
        known = {k: v for k, v in description.items() if k in cls.model_fields and v is not None}
        return cls.model_validate(known)

    @classmethod
    def from_sensor(cls, sensor: ImuSensor, T_base_sensor: _Seven | None = None) -> ImuParameters:
        """Return the parameters of an IMU in a rig file."""
        noise = sensor.noise
        given = {
            "gravity_mps2": sensor.gravity_mps2,
            "max_gyro_radps": sensor.max_gyro_radps,
            "max_accel_mps2": sensor.max_accel_mps2,
            "T_base_sensor": T_base_sensor,
            **({} if noise is None else {name: getattr(noise, name) for name in noise.__slots__}),
        }
        return cls.from_description(given)

    def description(self) -> dict[str, Any]:
        """Return what a mission's sensors hold under "imu"; JSON."""
        return self.model_dump(mode="json", exclude_none=True)
