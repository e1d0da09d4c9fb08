"""Where a robot with a planar laser is in a grid or a map that was made before, while it drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.floor import open_floor
from mapstream.operators.laser.floor_tracking import FloorConfig, FloorTracker
from mapstream.operators.laser.surfaces import surface_of
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.operators.places.map_poses import send_pose
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.sensors import LaserScan2D, WheelOdometry
from mapstream.streams.sync import anchored, window
from mapstream.streams.trajectory import Trajectory

_Moves = Sequence[WheelOdometry | Odometry]


class GridLocalizationConfig(FloorConfig):
    """Options of `grid_localization`."""

    map: Path = Field(description="a grid's YAML file, or the folder of a map of planar lasers")


@dataclass(frozen=True)
class Inputs:
    """Scans, and how the robot moves: by wheels, or by an odometry such as that of `laser_odometry`."""

    laser: Receiver[LaserScan2D]
    wheels: Receiver[WheelOdometry] | None = None
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    """One pose for each scan, at its end."""

    poses: Sender[MapPose]
    odometry: Sender[Odometry]  # the poses in the map alone, where the robot is not lost


class GridLocalization(Operator[Inputs, Outputs]):
    """Find a robot in an occupancy grid or a map of planar lasers, and follow it there; the map does not change.

    Nobody need say where it starts. It is lost until searches on the whole floor agree, and again when scans do not
    fit any more, as after it was carried elsewhere. `recovered` is the first pose after that.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: GridLocalizationConfig) -> None:
        self._config = config
        self._tracker: FloorTracker | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        moves = anchored(
            inputs.laser,
            window(inputs.wheels, optional=True),
            window(inputs.odometry, optional=True),
        )
        async for scan, wheels, odometry in moves:
            known = wheels or odometry
            if known is None:
                warn("scans of a time without wheels or odometry are left out")
                outputs.poses.advance(scan.end_ns)
                outputs.odometry.advance(scan.end_ns)
                continue
            pose = await offload(self.locate, scan, known)
            await send_pose(pose, outputs.poses, outputs.odometry)
        if self._tracker is not None and not self._tracker.has_tracked:
            warn("the robot was never found in the map")

    def locate(self, scan: LaserScan2D, moves: _Moves) -> MapPose:
        """Return where the robot is at the end of a scan.

        Args:
            scan: Later than the one before.
            moves: Wheels or odometry, in order of time, from before the sweep to its end or later.

        Raises:
            ValueError: If the odometry does not cover the scan's end.
            MapError: If there is no map, or one without walls.
        """
        if self._tracker is None:
            self._tracker = FloorTracker(open_floor(self._config.map), self._config)
        way = Trajectory(
            stamps_ns=np.array([move.stamp_ns for move in moves]),
            poses=np.stack([move.T_odom_base.matrix for move in moves]),
        )
        ends = beam_ends(scan, way)
        eye = scan.T_base_sensor.t[:2]
        surface = surface_of(ends.points[:, :2], eye)
        return self._tracker.track(ends.stamp_ns, surface, way.pose_at(ends.stamp_ns), eye)
