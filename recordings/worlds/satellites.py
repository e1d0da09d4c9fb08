"""A simulated satellite receiver: positions around a place on Earth, with noise, at the end of a lever."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.motion import Motion
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import GnssFix

ORIGIN_LLA = (47.3769, 8.5417, 450.0)  # [deg, deg, m] of the world's origin; x is east, y north
T_BASE_ANTENNA = SE3.from_rotation(np.eye(3), [-0.3, 0.0, 0.4])
_RADIUS_M = 6378137.0  # of WGS84, at the equator
_FLATTENING = 1 / 298.257223563
_SQUARE = _FLATTENING * (2 - _FLATTENING)  # of the eccentricity


class SatelliteConfig(BaseModel):
    """A receiver whose errors are white."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    rate_hz: NonNegativeFloat = 0.0
    """0: there is none."""
    sigma_m: PositiveFloat = 0.02
    """Of each axis."""


def satellite_fixes(
    config: SatelliteConfig, motion: Motion, stamps_ns: IntArray, rng: np.random.Generator
) -> Iterator[GnssFix]:
    """Yield one fix per stamp."""
    positions = (motion.poses(stamps_ns) @ T_BASE_ANTENNA.matrix)[:, :3, 3]
    positions += rng.normal(0.0, config.sigma_m, positions.shape)
    for stamp_ns, lla in zip(stamps_ns.tolist(), enu_to_lla(positions).tolist(), strict=True):
        yield GnssFix(
            stamp_ns=stamp_ns,
            latitude_deg=lla[0],
            longitude_deg=lla[1],
            altitude_m=lla[2],
            covariance_enu_m2=config.sigma_m**2 * np.eye(3),
            T_base_sensor=T_BASE_ANTENNA,
        )


def enu_to_lla(
    enu_m: FloatArray, origin_lla: tuple[float, float, float] = ORIGIN_LLA
) -> FloatArray:
    """Return latitudes, longitudes [deg] and heights [m] (N, 3) of points east, north, up of an origin.

    Source: Bowring, Transformation from Spatial to Geographical Coordinates, Survey Review 1976; iterated.
    """
    latitude, longitude = np.radians(origin_lla[:2])
    (sin_lat, cos_lat), (sin_lon, cos_lon) = (
        (np.sin(angle), np.cos(angle)) for angle in (latitude, longitude)
    )
    normal = _RADIUS_M / np.sqrt(1 - _SQUARE * sin_lat**2)
    reach = (normal + origin_lla[2]) * cos_lat
    height = (normal * (1 - _SQUARE) + origin_lla[2]) * sin_lat
    east = np.array([-sin_lon, cos_lon, 0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    earth = np.array([reach * cos_lon, reach * sin_lon, height]) + enu_m @ np.stack(
        [east, north, up]
    )
    around = np.hypot(earth[:, 0], earth[:, 1])
    angle = np.full(len(earth), latitude)
    for _ in range(6):  # each gains three digits
        radius = _RADIUS_M / np.sqrt(1 - _SQUARE * np.sin(angle) ** 2)
        angle = np.arctan2(earth[:, 2] + _SQUARE * radius * np.sin(angle), around)
    radius = _RADIUS_M / np.sqrt(1 - _SQUARE * np.sin(angle) ** 2)
    above = around * np.cos(angle) + earth[:, 2] * np.sin(angle)
    above -= radius * (1 - _SQUARE * np.sin(angle) ** 2)
    turned = np.arctan2(earth[:, 1], earth[:, 0])
    return np.stack([np.degrees(angle), np.degrees(turned), above], axis=1)
