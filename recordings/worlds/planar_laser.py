"""A simulated planar laser, whose beams fire one after the other while the robot moves."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LaserScan2D


class PlanarLaserConfig(BaseModel):
    """A laser behind a turning mirror."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    beams: int = Field(default=541, ge=2)
    fov_rad: float = Field(default=float(np.deg2rad(270)), gt=0, le=2 * np.pi)
    """From the first beam to the last, symmetric about the laser's x axis."""
    rate_hz: PositiveFloat = 10.0
    """The mirror's turns."""
    min_range_m: NonNegativeFloat = 0.05
    max_range_m: PositiveFloat = 20.0
    range_noise_m: NonNegativeFloat = 0.01
    dropout: float = Field(default=0.005, ge=0, le=1)
    """Share of returns that are lost."""


class PlanarLaser:
    """Casts each beam from where the sensor is at its time, so that sweeps are distorted by motion."""

    def __init__(
        self, config: PlanarLaserConfig, T_base_sensor: SE3, rng: np.random.Generator
    ) -> None:
        self.config = config
        self.T_base_sensor = T_base_sensor
        self._rng = rng
        self.period_ns = round(1e9 / config.rate_hz)
        step_rad = config.fov_rad / (config.beams - 1)
        self._beam_period_ns = int(self.period_ns * step_rad / (2 * np.pi))
        self._offsets_ns = np.arange(config.beams) * self._beam_period_ns
        self._angles_rad = -config.fov_rad / 2 + step_rad * np.arange(config.beams)
        cosine, sine = np.cos(self._angles_rad), np.sin(self._angles_rad)
        self._rays = np.stack([cosine, sine, np.zeros_like(cosine)], axis=1)

    @property
    def sweep_ns(self) -> int:
        """Return the time from the first beam to the last."""
        return int(self._offsets_ns[-1])

    def scan(self, caster: RayCaster, motion: Motion, stamp_ns: int) -> LaserScan2D:
        """Return the sweep that begins at `stamp_ns`."""
        config, rng = self.config, self._rng
        T_world_sensor = motion.poses(stamp_ns + self._offsets_ns) @ self.T_base_sensor.matrix
        directions = np.einsum("nij,nj->ni", T_world_sensor[:, :3, :3], self._rays)
        hits = caster.cast(np.ascontiguousarray(T_world_sensor[:, :3, 3]), directions)
        ranges = hits.ranges_m + rng.normal(0.0, config.range_noise_m, config.beams)
        seen = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)
        seen &= rng.random(config.beams) >= config.dropout
        return LaserScan2D(
            stamp_ns=stamp_ns,
            ranges_m=np.where(seen, ranges, np.nan).astype(np.float32),
            angle_min_rad=float(self._angles_rad[0]),
            angle_step_rad=float(self._angles_rad[1] - self._angles_rad[0]),
            range_min_m=config.min_range_m,
            range_max_m=config.max_range_m,
            beam_period_ns=self._beam_period_ns,
            T_base_sensor=self.T_base_sensor,
        )
