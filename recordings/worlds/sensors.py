"""Simulated sensors: a spinning LiDAR, an IMU and an odometry that drifts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.recordings.worlds.motion import GRAVITY_MPS2, Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan
from mapstream.streams.sensors import ImuNoise, ImuSensor

_LEAST_NOISE = 1e-9


class LidarConfig(BaseModel):
    """A spinning LiDAR: all beams of a column fire at once, columns one after the other."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    beams: PositiveInt = 32
    columns: PositiveInt = 512
    rate_hz: PositiveFloat = 10.0
    vertical_fov_rad: PositiveFloat = float(np.deg2rad(45))
    min_range_m: NonNegativeFloat = 0.4
    max_range_m: PositiveFloat = 60.0
    range_noise_m: NonNegativeFloat = 0.01
    dropout: NonNegativeFloat = 0.005
    """Share of returns that are lost."""


class ImuConfig(BaseModel):
    """Noise of an IMU; densities as in its data sheet."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    rate_hz: PositiveFloat = 200.0
    gyro_noise_radps_rthz: NonNegativeFloat = 1.7e-4
    accel_noise_mps2_rthz: NonNegativeFloat = 2.0e-3
    gyro_bias_radps: NonNegativeFloat = 2.0e-3
    """Standard deviation at the start, each axis."""
    accel_bias_mps2: NonNegativeFloat = 2.0e-2
    gyro_walk_radps2_rthz: NonNegativeFloat = 2.0e-5
    accel_walk_mps3_rthz: NonNegativeFloat = 3.0e-4

    def sensor(self, sensor_id: str) -> ImuSensor:
        """Return what a sensor file says of it; an IMU without noise is said to have little."""
        return ImuSensor(
            id=sensor_id,
            topic="/imu",
            frame="imu",
            noise=ImuNoise(
                gyro_density=max(self.gyro_noise_radps_rthz, _LEAST_NOISE),
                gyro_random_walk=max(self.gyro_walk_radps2_rthz, _LEAST_NOISE),
                accel_density=max(self.accel_noise_mps2_rthz, _LEAST_NOISE),
                accel_random_walk=max(self.accel_walk_mps3_rthz, _LEAST_NOISE),
            ),
            gravity_mps2=GRAVITY_MPS2,
            max_accel_mps2=150.0,
            max_gyro_radps=15.0,
        )


class Lidar:
    """Casts each column from where the sensor is at its time, so that sweeps are distorted by motion."""

    def __init__(self, config: LidarConfig, T_base_sensor: SE3, rng: np.random.Generator) -> None:
        self.config = config
        self.T_base_sensor = T_base_sensor
        self._rng = rng
        self.period_ns = round(1e9 / config.rate_hz)
        self._offsets_ns = np.arange(config.columns) * self.period_ns // config.columns
        azimuth = 2 * np.pi * np.arange(config.columns) / config.columns
        half = config.vertical_fov_rad / 2
        elevation = np.linspace(-half, half, config.beams)
        cosine = np.cos(elevation)
        self._rays = np.stack(  # (columns, beams, 3) in the sensor's frame
            [
                np.cos(azimuth)[:, None] * cosine,
                np.sin(azimuth)[:, None] * cosine,
                np.broadcast_to(np.sin(elevation), (config.columns, config.beams)),
            ],
            axis=-1,
        )
        self._ring = np.tile(np.arange(config.beams, dtype=np.uint16), config.columns)

    def scan(self, caster: RayCaster, motion: Motion, stamp_ns: int) -> LidarScan:
        """Return the sweep that begins at `stamp_ns`."""
        config, rng = self.config, self._rng
        T_world_sensor = motion.poses(stamp_ns + self._offsets_ns) @ self.T_base_sensor.matrix
        R = T_world_sensor[:, :3, :3]
        directions = (self._rays @ np.swapaxes(R, 1, 2)).reshape(-1, 3)
        hits = caster.cast(np.repeat(T_world_sensor[:, :3, 3], config.beams, axis=0), directions)
        ranges = hits.ranges_m + rng.normal(0.0, config.range_noise_m, len(directions))
        seen = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)
        seen &= rng.random(len(directions)) >= config.dropout
        faces = hits.faces[seen]
        incidence = np.abs(np.einsum("ij,ij->i", directions[seen], caster.normals[faces]))
        intensity = np.rint(255 * caster.mesh.reflectivity[faces] * incidence)  # Lambert's law
        return LidarScan(
            stamp_ns=stamp_ns,
            points=ranges[seen, None] * self._rays.reshape(-1, 3)[seen],
            intensity=intensity,
            ring=self._ring[seen],
            offsets_ns=np.repeat(self._offsets_ns, config.beams)[seen],
            T_base_sensor=self.T_base_sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSeries:
    """What an IMU measured, and the biases it had."""

    stamps_ns: IntArray  # (N,)
    gyro_radps: FloatArray  # (N, 3)
    accel_mps2: FloatArray  # (N, 3)
    gyro_biases_radps: FloatArray  # (N, 3)
    accel_biases_mps2: FloatArray  # (N, 3)
    T_base_sensor: SE3

    def biases_at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the biases of the gyroscope and the accelerometer (3,) at a time."""
        row = min(int(np.searchsorted(self.stamps_ns, stamp_ns)), len(self.stamps_ns) - 1)
        return self.gyro_biases_radps[row], self.accel_biases_mps2[row]

    def batches(self) -> Iterator[ImuBatch]:
        """Yield a tenth of a second at a time."""
        period_ns = int(self.stamps_ns[1] - self.stamps_ns[0])
        size = max(1, 10**8 // period_ns)
        for start in range(0, len(self.stamps_ns), size):
            rows = slice(start, start + size)
            yield ImuBatch(
                stamps_ns=self.stamps_ns[rows],
                gyro_radps=self.gyro_radps[rows],
                accel_mps2=self.accel_mps2[rows],
                T_base_sensor=self.T_base_sensor,
            )


def imu_series(
    config: ImuConfig,
    T_base_sensor: SE3,
    motion: Motion,
    span_ns: tuple[int, int],
    rng: np.random.Generator,
) -> ImuSeries:
    """Return the samples from a time to another, both included."""
    stamps_ns = np.arange(span_ns[0], span_ns[1] + 1, round(1e9 / config.rate_hz))
    shape, rate_hz = (len(stamps_ns), 3), config.rate_hz
    gyro_biases = _bias(config.gyro_bias_radps, config.gyro_walk_radps2_rthz, rate_hz, shape, rng)
    gyro_radps = motion.angular_velocity(stamps_ns) @ T_base_sensor.R + gyro_biases
    gyro_radps += rng.normal(0.0, config.gyro_noise_radps_rthz * np.sqrt(rate_hz), shape)
    accel_biases = _bias(config.accel_bias_mps2, config.accel_walk_mps3_rthz, rate_hz, shape, rng)
    accel_mps2 = motion.specific_force(stamps_ns, T_base_sensor) + accel_biases
    accel_mps2 += rng.normal(0.0, config.accel_noise_mps2_rthz * np.sqrt(rate_hz), shape)
    return ImuSeries(
        stamps_ns=stamps_ns,
        gyro_radps=gyro_radps,
        accel_mps2=accel_mps2,
        gyro_biases_radps=gyro_biases,
        accel_biases_mps2=accel_biases,
        T_base_sensor=T_base_sensor,
    )


def imu_batches(
    config: ImuConfig, T_base_sensor: SE3, motion: Motion, rng: np.random.Generator
) -> Iterator[ImuBatch]:
    """Yield the samples of a whole motion, a tenth of a second at a time."""
    span_ns = (motion.start_ns, motion.end_ns)
    return imu_series(config, T_base_sensor, motion, span_ns, rng).batches()


def _bias(
    start: float, walk: float, rate_hz: float, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """Return a random walk (N, 3) from a random start, whose density is `walk`."""
    steps = rng.normal(0.0, walk / np.sqrt(rate_hz), shape)
    return rng.normal(0.0, start, 3) + np.cumsum(steps, axis=0)


def drifting_odometry(
    poses: FloatArray,
    stamps_ns: IntArray,
    drift: float,
    rng: np.random.Generator,
    *,
    turn_radpm: float = 0.0,
) -> Iterator[Odometry]:
    """Yield odometry whose error grows by about `drift` of the distance.

    Every step is stretched by a fixed factor, and turned by a random walk of the heading, and by
    `turn_radpm` for each metre.
    """
    steps = invert(poses[:-1]) @ poses[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    errors = np.zeros((len(steps), 6))
    errors[:, 2] = rng.normal(0.0, 0.1 * drift, len(steps)) * np.sqrt(lengths)
    errors[:, 2] += turn_radpm * lengths
    steps[:, :3, 3] *= 1 + drift * rng.choice([-1, 1])
    T = poses[0]
    yield Odometry(stamp_ns=int(stamps_ns[0]), T_odom_base=SE3(T))
    for stamp_ns, step in zip(stamps_ns[1:], steps @ se3_exp(errors), strict=True):
        T = T @ step
        yield Odometry(stamp_ns=int(stamp_ns), T_odom_base=SE3(T))
