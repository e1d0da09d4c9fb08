"""From poses in a frame of the world to measurements on a trajectory: motion capture, fiducials, localisation."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from mapstream.operators.edge_covariance import PoseCovariance
from mapstream.operators.operator import Operator, OperatorConfig, report_loss
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Odometry

_Seven = Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]
_HERE: _Seven = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class AbsolutePosesConfig(OperatorConfig):
    """Options of `absolute_poses`; transforms are x, y, z [m] and the quaternion x, y, z, w."""

    frame: str = "room"
    """Name of the frame in which the poses are."""
    T_map_frame: _Seven | None = None
    """Where it lies in the map; left out, an optimizer finds it."""
    T_base_sensor: _Seven = _HERE
    """What was measured: the marker, the tag's camera ..."""
    sensor: str = ""
    """Its name in the mission's sensors, if an optimizer shall find where it sits."""
    covariance: PoseCovariance = PoseCovariance(sigma_rad=0.01, sigma_m=0.01)
    """Of each pose, where the message has none."""
    is_switchable: bool = False
    """An optimizer may find that a pose is false."""


@dataclass(frozen=True)
class Inputs:
    """Poses in the frame; the name of their message does not matter, they do not drift."""

    poses: Receiver[Odometry]


@dataclass(frozen=True)
class Outputs:
    """Measurements of kind `absolute`, in all six directions."""

    constraints: Sender[Constraint]


class AbsolutePoses(Operator[Inputs, Outputs]):
    """Turn poses that something else measured into measurements on the trajectory."""

    def __init__(self, config: AbsolutePosesConfig) -> None:
        self._config = config
        known = None if config.T_map_frame is None else _transform(config.T_map_frame)
        self._outer = OuterFrame(name=config.frame, T_map_frame=known)
        self._T_base_sensor = _transform(config.T_base_sensor)
        self._payload = json.dumps({"sensor": config.sensor}).encode() if config.sensor else b""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for pose in inputs.poses:
            if pose.is_lost:
                report_loss("poses that were predicted, not measured")
                outputs.constraints.advance(pose.stamp_ns)
                continue
            await outputs.constraints.send(self.measurement(pose))

    def measurement(self, pose: Odometry) -> Constraint:
        """Return what a pose says of the trajectory."""
        config = self._config
        is_found = bool(config.sensor)  # then the place is the mission's, not the measurement's
        return Constraint(
            stamp_ns=pose.stamp_ns,
            kind="absolute",
            T_a_b=pose.T_odom_base,
            covariance=config.covariance.of(pose.covariance),
            T_base_sensor=SE3.identity() if is_found else self._T_base_sensor,
            outer=self._outer,
            payload=self._payload,
            is_switchable=config.is_switchable,
            source=config.sensor or config.frame,
        )


def _transform(numbers: _Seven) -> SE3:
    return SE3.from_quat_xyzw(numbers[3:], numbers[:3])
