"""Walls as a planar laser sees them: lines, which are planes whose tilt is not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.lines import LineConfig, Lines, find_lines
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.period import Spacing
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.sync import anchored, window
from mapstream.streams.trajectory import Trajectory


class LaserLinesConfig(OperatorConfig):
    """Options of `laser_lines`."""

    period_s: NonNegativeFloat = 0.5
    """Between two scans that are looked at; 0: all are."""
    lines: LineConfig = Field(default_factory=LineConfig)


@dataclass(frozen=True)
class Inputs:
    """Scans, and how the robot moved while they were taken; without it, it counts as standing."""

    laser: Receiver[LaserScan2D]
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    """The walls of each scan that was looked at, at the end of its sweep."""

    planes: Sender[PlaneSegments]


class LaserLines(Operator[Inputs, Outputs]):
    """Find straight walls in the scans of a planar laser, for landmarks that depth cameras see as planes."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LaserLinesConfig) -> None:
        self._config = config
        self._spacing = Spacing(config.period_s)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        way = window(inputs.odometry, optional=True)
        async for scan, odometry in anchored(inputs.laser, way):
            if not self._spacing.allows(scan.stamp_ns):
                outputs.planes.advance(scan.stamp_ns)
                continue
            if inputs.odometry is not None and odometry is None:
                warn("scans of a time without odometry; the robot counts as standing")
            await outputs.planes.send(await offload(self.find, scan, odometry or ()))

    def find(self, scan: LaserScan2D, odometry: Sequence[Odometry] = ()) -> PlaneSegments:
        """Return the walls of one scan, seen from the base at the end of its sweep.

        Args:
            scan: The sweep.
            odometry: In order of time; it must cover the sweep to be of use.
        """
        ends = beam_ends(scan, _way_of(odometry))
        in_sensor = scan.T_base_sensor.inverse() @ ends.points
        lines = find_lines(in_sensor[:, :2], self._config.lines)
        return _segments(lines, scan, ends.stamp_ns)


def _way_of(odometry: Sequence[Odometry]) -> Trajectory | None:
    if not odometry:
        return None
    return Trajectory(
        stamps_ns=np.array([each.stamp_ns for each in odometry]),
        poses=np.stack([each.T_odom_base.matrix for each in odometry]),
    )


def _segments(lines: Lines, scan: LaserScan2D, stamp_ns: int) -> PlaneSegments:
    """Return the upright planes over lines in the laser's plane: x along the line, z towards the laser."""
    T = np.zeros((len(lines), 4, 4))
    x, y = lines.directions.T
    T[:, :2, 0] = lines.directions
    T[:, 2, 1] = -1  # downwards, since x is to the right as seen from the laser
    T[:, 0, 2], T[:, 1, 2] = -y, x
    T[:, :2, 3] = lines.middles
    T[:, 3, 3] = 1
    covariances = np.zeros((len(lines), 6, 6))
    diagonal = np.full((len(lines), 6), np.inf)
    diagonal[:, 1], diagonal[:, 5] = lines.sigmas_rad**2, lines.sigmas_m**2
    covariances[:, range(6), range(6)] = diagonal
    return PlaneSegments(
        stamp_ns=stamp_ns,
        T_base_plane=scan.T_base_sensor.matrix @ T,
        covariances=covariances,
        hulls_m=tuple(np.stack([ends, np.zeros(2)], axis=1) for ends in lines.ends_m),
        num_points=lines.num_points,
        rmse_m=lines.rmse_m,
        frame=scan.frame,
        T_base_sensor=scan.T_base_sensor,
    )
