"""Odometry that fails: steps that no robot can make are found, and trusted no more than they deserve.

Each step is compared with the one before: velocity changes by no more than the acceleration of the robot allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat

from mapstream.operators.odometry.uncertainty import diagonal, unmeasured
from mapstream.operators.operator import Operator, OperatorConfig, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry


class OdometryGuardConfig(OperatorConfig):
    """Options of `odometry_guard`: what the robot can do, and what becomes of a step beyond it."""

    max_speed_mps: PositiveFloat = 50.0
    max_accel_mps2: PositiveFloat = 15.0
    """Velocity changes by no more in a second; beside it, `noise_m` of every step are believed."""
    max_turn_radps: PositiveFloat = 10.0
    max_turn_accel_radps2: PositiveFloat = 30.0
    noise_m: PositiveFloat = 0.05
    noise_rad: PositiveFloat = 0.03
    on_jump: Literal["inflate", "bridge", "split"] = "inflate"
    """inflate: the step counts, with the jump as its deviation; bridge: the motion before goes on in its
    place; split: a new mission begins."""
    max_jumps: NonNegativeInt = 3
    """After so many in a row the odometry is believed: that is how the robot moves."""


@dataclass(frozen=True)
class Inputs:
    odometry: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    """The same moments; only steps that are jumps differ."""

    odometry: Sender[Odometry]


@dataclass(frozen=True, slots=True)
class Jump:
    """How far a step is from what the robot can do."""

    rotation_rad: float  # beyond the motion that would have gone on
    translation_m: float


class OdometryGuard(Operator[Inputs, Outputs]):
    """Find jumps of odometry, and inflate their covariance, bridge them, or begin a new mission."""

    def __init__(self, config: OdometryGuardConfig) -> None:
        self._config = config
        self._previous: Odometry | None = None
        self._rate: np.ndarray[tuple[int], np.dtype[np.float64]] | None = None  # (6,) per second
        self._num_jumps = 0  # in a row
        self._T_out_odom = SE3.identity()  # undoes the jumps that were bridged

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for odometry in inputs.odometry:
            previous = self._previous
            if previous is not None and odometry.stamp_ns <= previous.stamp_ns:
                report_loss("odometry whose stamp does not increase")
                continue
            jump = self.look(odometry)
            if jump is not None and self._config.on_jump == "split":
                outputs.odometry.start_epoch()
            await outputs.odometry.send(self.guarded(odometry, previous, jump))

    def look(self, odometry: Odometry) -> Jump | None:
        """Take the next message in; return by how much it jumped if it did."""
        previous, self._previous = self._previous, odometry
        if previous is None:
            return None
        elapsed_s = (odometry.stamp_ns - previous.stamp_ns) / 1e9
        step = (previous.T_odom_base.inverse() @ odometry.T_odom_base).log()
        jump = self._jump(step, elapsed_s)
        if jump is None or self._num_jumps >= self._config.max_jumps:
            self._rate, self._num_jumps = step / elapsed_s, 0
            return None
        self._num_jumps += 1
        warn("steps of the odometry that no robot makes: " + _CONSEQUENCES[self._config.on_jump])
        return jump

    def _jump(self, step: np.ndarray[tuple[int], np.dtype[np.float64]], dt_s: float) -> Jump | None:
        config = self._config
        expected = np.zeros(6) if self._rate is None else self._rate * dt_s
        off_rad, off_m = (float(np.linalg.norm(part)) for part in np.split(step - expected, 2))
        turn_rad, way_m = (float(np.linalg.norm(part)) for part in np.split(step, 2))
        is_fast = way_m > config.max_speed_mps * dt_s + config.noise_m
        is_fast |= turn_rad > config.max_turn_radps * dt_s + config.noise_rad
        is_sudden = off_m > config.max_accel_mps2 * dt_s**2 + config.noise_m
        is_sudden |= off_rad > config.max_turn_accel_radps2 * dt_s**2 + config.noise_rad
        knows_rate = self._rate is not None
        return Jump(off_rad, off_m) if is_fast or (is_sudden and knows_rate) else None

    def guarded(self, odometry: Odometry, previous: Odometry | None, jump: Jump | None) -> Odometry:
        """Return the message as it goes out."""
        T_out_base = self._T_out_odom @ odometry.T_odom_base
        turned = self._turned(odometry)
        if jump is None or previous is None:
            return replace(turned, T_odom_base=T_out_base)
        if self._config.on_jump == "split":
            return replace(turned, T_odom_base=T_out_base, covariance=None)
        if self._config.on_jump == "inflate":
            known = np.zeros((6, 6)) if odometry.covariance is None else odometry.covariance
            added = diagonal(
                jump.rotation_rad + self._config.noise_rad,
                jump.translation_m + self._config.noise_m,
            )
            return replace(turned, T_odom_base=T_out_base, covariance=known + added)
        elapsed_s = (odometry.stamp_ns - previous.stamp_ns) / 1e9
        rate = np.zeros(6) if self._rate is None else self._rate
        T_out_base = self._T_out_odom @ previous.T_odom_base @ SE3.exp(rate * elapsed_s)
        self._T_out_odom = T_out_base @ odometry.T_odom_base.inverse()
        bridged = replace(self._turned(odometry), T_odom_base=T_out_base, is_lost=True)
        return replace(bridged, covariance=unmeasured(elapsed_s))

    def _turned(self, odometry: Odometry) -> Odometry:
        """Return the message with its velocity in the frame that goes out."""
        if odometry.velocity_mps is None:
            return odometry
        return replace(odometry, velocity_mps=self._T_out_odom.R @ odometry.velocity_mps)


_CONSEQUENCES = {
    "inflate": "they count little",
    "bridge": "the motion before them goes on in their place",
    "split": "a new mission begins at each",
}
