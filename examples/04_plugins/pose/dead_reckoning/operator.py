"""A pose source: the robot's own odometry, with an uncertainty that grows with what it did.

Source: Thrun, Burgard, Fox: Probabilistic Robotics, 2005, section 5.4.
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.streams import SE3, Odometry, Receiver, Sender


class DeadReckoningConfig(OperatorConfig):
    """How wrong a step is: a part of the turn and of the distance, and a little in any case."""

    turn_per_turn: PositiveFloat = 0.02
    turn_per_m: PositiveFloat = 0.002  # [rad/m]
    slip: PositiveFloat = 0.01  # of the distance
    least: PositiveFloat = 1e-3  # [rad] and [m]


@dataclass(frozen=True)
class Inputs:
    odometry: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    odometry: Sender[Odometry]  # the same poses; each step has a covariance


class DeadReckoning(Operator[Inputs, Outputs]):
    """Say how uncertain each step of recorded odometry is."""

    def __init__(self, config: DeadReckoningConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        before: SE3 | None = None
        async for odometry in inputs.odometry:
            now = odometry.T_odom_base
            step = SE3.identity() if before is None else before.inverse() @ now
            await outputs.odometry.send(replace(odometry, covariance=self.uncertainty(step)))
            before = now

    def uncertainty(self, step: SE3) -> np.ndarray:
        """Return the covariance (6, 6) of a step, rotation first [rad, m]."""
        config, length_m = self._config, float(np.linalg.norm(step.t))
        sigma_rad = config.turn_per_turn * step.angle_rad + config.turn_per_m * length_m
        sigmas = np.repeat([sigma_rad, config.slip * length_m], 3) + config.least
        return np.diag(sigmas**2)
