"""From satellite fixes to positions in a plane, as measurements on poses."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.gnss.geodesy import GeodeticPlane
from mapstream.operators.operator import Operator, OperatorConfig, report_loss, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.sensors import GnssFix


class GnssConfig(OperatorConfig):
    """Options of `gnss`."""

    crs: str = "enu"
    """The plane: `enu` at the origin, `utm` (the origin's zone), or a projection as `EPSG:2056`."""
    origin_lla: tuple[float, float, float] | None = None
    """Its zero: latitude, longitude [deg], height [m]; left out, it is the first fix.
    Missions that share a map need one."""
    frame: str = ""
    """Name of the outer frame in the map; left out, that of the plane as given."""
    is_map_frame: bool = False
    """The map's own frame is this one; otherwise an optimizer finds where it lies in the map."""
    sigma_horizontal_m: PositiveFloat = 3.0
    """Where the fix has no covariance."""
    sigma_vertical_m: PositiveFloat = 6.0
    """The same, of heights."""
    min_sigma_m: NonNegativeFloat = 0.005
    """Receivers that say they are better than this are not believed."""
    sensor: str = ""
    """Name of the antenna among the mounts of `trajectory`, if an optimizer shall find where it sits."""
    is_switchable: bool = False
    """An optimizer may find that a position is false."""


@dataclass(frozen=True)
class Inputs:
    """Fixes on the ellipsoid."""

    fixes: Receiver[GnssFix]


@dataclass(frozen=True)
class Outputs:
    """Positions of the antenna, of kind `position`."""

    constraints: Sender[Constraint]


class Gnss(Operator[Inputs, Outputs]):
    """Turn satellite fixes into positions in a plane that touches the Earth where the robot is.

    The antenna's place on the robot goes along, so that turns of the robot do not count as errors.
    A fix without a height still says where the robot is in the plane. One without a position is refused.
    """

    def __init__(self, config: GnssConfig) -> None:
        self._config = config
        self._plane: GeodeticPlane | None = None
        self._outer: OuterFrame | None = None
        self._payload = json.dumps({"sensor": config.sensor}).encode() if config.sensor else b""
        if config.origin_lla is not None:
            self._begin(config.origin_lla)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for fix in inputs.fixes:
            constraint = self.position(fix)
            if constraint is not None:
                await outputs.constraints.send(constraint)
            else:
                outputs.constraints.advance(fix.stamp_ns)

    def position(self, fix: GnssFix) -> Constraint | None:
        """Return the measurement that a fix is, or None of one that says nothing; that is counted."""
        lla = np.array([fix.latitude_deg, fix.longitude_deg, fix.altitude_m])
        refusal = _refusal(lla)
        if refusal:
            report_loss(refusal)
            return None
        has_height = bool(np.isfinite(lla[2]))
        if self._plane is None:
            if not has_height:
                report_loss("fixes without a height before the first with one, which is the origin")
                return None
            self._begin((lla[0], lla[1], lla[2]))
        plane = self._plane
        assert plane is not None  # noqa: S101  # begun above
        if not has_height:
            lla[2] = plane.origin_lla[2]
        place = plane.to_plane(lla[None])[0]
        covariance = np.diag(np.full(6, np.inf))
        axes = plane.axes_at(lla)
        covariance[3:, 3:] = axes @ self._covariance_enu(fix) @ axes.T
        if not has_height:
            covariance[5, :], covariance[:, 5] = 0, 0
            covariance[5, 5] = np.inf
        return Constraint(
            stamp_ns=fix.stamp_ns,
            kind="position",
            T_a_b=SE3.from_rotation(np.eye(3), place),
            covariance=covariance,
            T_base_sensor=SE3.identity() if self._payload else fix.T_base_sensor,
            outer=self._outer,
            payload=self._payload,
            is_switchable=self._config.is_switchable,
            source=fix.frame,
        )

    def _begin(self, origin_lla: tuple[float, float, float]) -> None:
        config = self._config
        self._plane = GeodeticPlane.at(config.crs, origin_lla)
        known = {"T_map_frame": SE3.identity()} if config.is_map_frame else {}
        self._outer = self._plane.outer_frame(config.frame or config.crs, **known)

    def _covariance_enu(self, fix: GnssFix) -> FloatArray:
        """Return (3, 3) east, north, up: of the fix where it has one, otherwise the constant."""
        config, given = self._config, fix.covariance_enu_m2
        sigmas = [config.sigma_horizontal_m, config.sigma_horizontal_m, config.sigma_vertical_m]
        constant = np.diag(np.square(sigmas))
        if given is None:
            return constant
        if not np.isfinite(given).all() or np.linalg.eigvalsh((given + given.T) / 2)[0] <= 0:
            warn("fixes whose covariance is not positive definite have the constant one")
            return constant
        variances, directions = np.linalg.eigh((given + given.T) / 2)
        floored = np.maximum(variances, config.min_sigma_m**2)
        return np.asarray((directions * floored) @ directions.T)


def _refusal(lla: FloatArray) -> str:
    """Return why a fix is no position; empty if it is one."""
    if not np.isfinite(lla[:2]).all():
        return "fixes without a position (NaN)"
    if abs(lla[0]) > 90 or abs(lla[1]) > 360:
        return "fixes that are nowhere on Earth"
    if not lla[:2].any():
        return "fixes at latitude 0, longitude 0, which receivers without a position send"
    return ""
