"""Odometry of a planar laser by matching scans to those before (Censi, PLICP, ICRA 2008)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.laser.planar import lifted, lifted_covariance, rotation
from mapstream.operators.laser.tracker import Tracker, TrackerConfig
from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    Placement,
    offload,
    report_loss,
    warn,
)
from mapstream.streams.anchored import anchored, window
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import LaserScan2D, WheelOdometry


class LaserOdometryConfig(OperatorConfig):
    """Options of `laser_odometry`."""

    num_keyframes: PositiveInt = 15
    """So many keyframes are what a scan is matched to."""
    keyframe_distance_m: PositiveFloat = 0.3
    keyframe_angle_deg: PositiveFloat = 15.0
    cell_m: PositiveFloat = 0.05
    """One point in such a cell is kept of what keyframes saw, and of the clouds that are sent on."""
    max_range_m: PositiveFloat = 30.0
    """Beams that are longer do not count."""
    min_inlier_fraction: float = Field(default=0.35, ge=0.0, le=1.0)
    """With fewer points on lines a match is not believed."""
    max_lost_scans: PositiveInt = 5
    """After so many scans that were not believed the keyframes start anew at the predicted pose."""
    wheel_sigma_yaw_rad: PositiveFloat = 0.05
    """Of the wheels, or the odometry, after a metre of way; it grows with the root of the way."""
    wheel_sigma_m: PositiveFloat = 0.05
    turn_m_per_rad: PositiveFloat = 0.5
    """The way that a turn on the spot counts for."""
    accel_mps2: PositiveFloat = 1.0
    """Without wheels velocity is expected to change by no more in a second."""
    turn_accel_radps2: PositiveFloat = 2.0
    ground_sigma_rad: PositiveFloat = 0.002
    """How far the ground tilts in one step: roll and pitch, which a planar laser does not see."""
    ground_sigma_m: PositiveFloat = 0.005
    """How far it rises in one step."""


@dataclass(frozen=True)
class Inputs:
    """Scans, and what is known of the motion without them: wheels, or an odometry of another sensor."""

    laser: Receiver[LaserScan2D]
    wheels: Receiver[WheelOdometry] | None = None
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    odometry: Sender[Odometry]  # one per scan, at the scan's end
    clouds: Sender[PointCloud]  # one per odometry, with its stamp


class LaserOdometry(Operator[Inputs, Outputs]):
    """Track a planar laser against what its last keyframes saw.

    The odom frame is the base at the end of the first scan. Motion is predicted by the wheels where they are
    connected, else by constant velocity, and weighed with the scan, so that in a bare corridor the wheels say how far
    along it the robot is. A scan that does not fit is searched for on a grid of poses around the prediction. If that
    fails too, the step is the wheels'; without wheels it is predicted, and the message says `is_lost`.
    """

    placement: ClassVar[Placement] = "thread"  # KD-trees free the interpreter

    def __init__(self, config: LaserOdometryConfig) -> None:
        self._config = config
        self._tracker = Tracker(
            TrackerConfig(
                num_keyframes=config.num_keyframes,
                keyframe_m=config.keyframe_distance_m,
                keyframe_rad=float(np.radians(config.keyframe_angle_deg)),
                cell_m=config.cell_m,
                max_range_m=config.max_range_m,
                min_inlier_fraction=config.min_inlier_fraction,
                max_lost_scans=config.max_lost_scans,
                wheels=np.array(
                    [config.wheel_sigma_yaw_rad, config.wheel_sigma_m, config.wheel_sigma_m]
                ),
                turn_m_per_rad=config.turn_m_per_rad,
                accelerations=np.array(
                    [config.turn_accel_radps2, config.accel_mps2, config.accel_mps2]
                ),
            )
        )
        self._last_ns: int | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        around = anchored(
            inputs.laser,
            window(inputs.wheels, optional=True),
            window(inputs.odometry, optional=True),
        )
        async for scan, wheels, others in around:
            if self._last_ns is not None and scan.end_ns <= self._last_ns:
                report_loss("scans whose stamp does not increase")
                continue
            self._last_ns = scan.end_ns
            odometry, cloud = await offload(self.register, scan, wheels or others or ())
            await outputs.odometry.send(odometry)
            await outputs.clouds.send(cloud)

    def register(
        self, scan: LaserScan2D, wheels: Sequence[WheelOdometry | Odometry] = ()
    ) -> tuple[Odometry, PointCloud]:
        """Track one scan.

        Args:
            scan: Later than the one before.
            wheels: Messages from its start to its end, or beyond; none where nothing is known.
        """
        config, stamp_ns = self._config, scan.end_ns
        found = self._tracker.track(scan, pose_at(wheels, stamp_ns) if wheels else None)
        if found.problem:
            instead = "the wheels lead" if found.has_wheels else "its step is predicted"
            warn(f"scan at {scan.stamp_ns} ns could not be matched: {found.problem}; {instead}")
        odometry = Odometry(
            stamp_ns=stamp_ns,
            T_odom_base=lifted(found.pose),
            covariance=lifted_covariance(
                found.covariance, config.ground_sigma_rad, config.ground_sigma_m
            ),
            velocity_mps=np.append(rotation(found.pose[2]) @ found.velocity[1:], 0.0),
            is_lost=bool(found.problem) and not found.has_wheels,
        )
        kept = voxel_indices(found.points, config.cell_m)
        cloud = PointCloud(
            stamp_ns=stamp_ns, points=found.points[kept].astype(np.float32), record=scan.record
        )
        return odometry, cloud


def pose_at(messages: Sequence[WheelOdometry | Odometry], stamp_ns: int) -> SE3:
    """Return T_odom_base at a time between messages, which are in order, or at the nearest end of them."""
    after = next((m for m in messages if m.stamp_ns >= stamp_ns), messages[-1])
    before = next((m for m in reversed(messages) if m.stamp_ns <= stamp_ns), messages[0])
    if after.stamp_ns == before.stamp_ns:
        return after.T_odom_base
    fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return before.T_odom_base.interpolate(after.T_odom_base, min(max(fraction, 0.0), 1.0))
