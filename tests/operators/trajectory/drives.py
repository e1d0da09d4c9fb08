"""A short drive seen by wheels, visual odometry and an IMU, and measurements along it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mapstream.operators.trajectory.builder import TrajectoryBuilder
from mapstream.operators.trajectory.imu_source import ImuSource
from mapstream.operators.trajectory.links import Links
from mapstream.operators.trajectory.motion_models import MotionModel
from mapstream.operators.trajectory.sources import (
    AxisSigmas,
    OdometrySource,
    PoseSource,
    WheelSource,
)
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3
from mapstream.streams.join import END
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Odometry, Submap
from mapstream.streams.messages.sensors import ImuBatch, WheelOdometry

MISSION = "0123456789abcdef" * 2
MS = 1_000_000
TWIST = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])  # per second
WHEEL_SIGMAS: AxisSigmas = {
    "roll": None,
    "pitch": None,
    "yaw": 0.02,
    "x": 0.05,
    "y": 0.03,
    "z": None,
}
Message = WheelOdometry | Odometry | ImuBatch | Constraint


def pose_at(stamp_ns: int) -> SE3:
    return SE3.exp(TWIST * stamp_ns / 1e9)


def wheels(stamp_ns: int) -> WheelOdometry:
    return WheelOdometry(stamp_ns=stamp_ns, T_odom_base=pose_at(stamp_ns))


def odometry(stamp_ns: int) -> Odometry:
    return Odometry(stamp_ns=stamp_ns, T_odom_base=pose_at(stamp_ns), covariance=np.eye(6) * 1e-4)


def imu(stamp_ns: int, *, num: int = 5, period_ns: int = 10 * MS) -> ImuBatch:
    """Return samples that end at a stamp, of a robot that turns at constant speed."""
    stamps_ns = stamp_ns - np.arange(num)[::-1] * period_ns
    gyro, accel = TWIST[:3], [0.0, TWIST[2] * TWIST[3], 9.81]
    return ImuBatch(
        stamps_ns=stamps_ns, gyro_radps=np.tile(gyro, (num, 1)), accel_mps2=np.tile(accel, (num, 1))
    )


def fix(stamp_ns: int) -> Constraint:
    covariance = np.diag([np.inf] * 3 + [0.01] * 3)
    return Constraint(
        stamp_ns=stamp_ns,
        kind="position",
        T_a_b=SE3.from_rotation(np.eye(3), pose_at(stamp_ns).t),
        covariance=covariance,
        outer=OuterFrame(name="enu"),
        source="gnss",
    )


class Robot:
    """Sources of motion and a builder that they feed; submaps become a map."""

    def __init__(
        self,
        *,
        window_ns: int | None,
        bridge: MotionModel | None = None,
        has_imu: bool = True,
    ) -> None:
        max_gap_ns = 150 * MS
        self.wheels = WheelSource(WHEEL_SIGMAS, max_gap_ns=max_gap_ns)
        self.visual = OdometrySource(np.eye(6) * 1e-4, max_gap_ns=max_gap_ns)
        self.imu = ImuSource(max_gap_ns=max_gap_ns)
        sources: dict[str, PoseSource] = {"visual": self.visual, "wheels": self.wheels}
        links = Links(MISSION, sources, self.imu if has_imu else None, bridge)
        self.builder = TrajectoryBuilder(links, window_ns=window_ns)
        self.submaps: list[Submap] = []
        self._known_ns: dict[str, int] = {}  # by source, once it began

    def hear(self, message: Message) -> None:
        """Take one message, and put out what may go."""
        if isinstance(message, Constraint):
            self.builder.add(message)
        elif isinstance(message, WheelOdometry):
            self.wheels.add_wheels(message)
            self._known_ns["wheels"] = message.stamp_ns
        elif isinstance(message, Odometry):
            self.visual.add(message)
            self._known_ns["visual"] = message.stamp_ns
        else:
            self.imu.add(message)
            self._known_ns["imu"] = message.stamp_ns
        self.commit(min(self._known_ns.values(), default=-1))

    def commit(self, known_ns: int) -> None:
        submap = self.builder.commit(known_ns)
        if submap is not None:
            self.submaps.append(submap)

    def drive(self, messages: Iterable[Message]) -> Map:
        """Hear all messages, and return the map in its canonical order."""
        self.hear_all(messages)
        return self.map()

    def hear_all(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self.hear(message)
        self.commit(END)

    def map(self) -> Map:
        map_ = Map.empty()
        for submap in self.submaps:
            map_ = append_submap(map_, submap)
        return in_canonical_order(map_)
