"""Trajectory management as an operator: measurements of any sensor in, one connected trajectory out.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import anyio

from mapstream.operators.operator import DynamicPorts, Operator, Ports, report_loss
from mapstream.operators.trajectory.assembly import (
    bridge_of,
    imu_source_of,
    source_of,
    trigger_of,
)
from mapstream.operators.trajectory.builder import TrajectoryBuilder
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.links import Links
from mapstream.operators.trajectory.rig_imu import with_rig
from mapstream.operators.trajectory.sources import OdometrySource, WheelSource
from mapstream.recordings.maps.ids import mission_id
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.join import END
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.estimates import Odometry, PointCloud, Submap
from mapstream.streams.messages.sensors import ImuBatch, Message, WheelOdometry
from mapstream.streams.messages.vision import NFrame
from mapstream.streams.sync import merge

_SECOND_NS = 1_000_000_000
_SEEN = ("clouds", "n_frames")  # inputs whose messages poses keep


@dataclass(frozen=True)
class Outputs:
    """The trajectory in submaps, and where the robot is now, ahead of them."""

    submaps: Sender[Submap]
    predictions: Sender[Odometry]


class Trajectory(DynamicPorts, Operator[Ports, Outputs]):
    """Make a pose for each stamp that a measurement asks for, and link the poses by every source of motion.

    Poses wait for measurements that come late, for a window; what comes later still splits a stretch that
    went out. Where nothing asks, poses are made by time and motion of the first source.
    The mission's id comes from the first stamp, the epoch and `mission`: a replay gives it again.
    """

    def __init__(self, config: TrajectoryConfig) -> None:
        self._config = config = with_rig(config)
        window_s = config.window_s or 0.0
        memory_s = 2 * config.late_s + window_s + config.submap_s + 10.0
        keep_ns = END if config.window_s is None else round(memory_s * _SECOND_NS)
        used = [name for name in config.sources if name not in config.without]
        self._sources = {name: source_of(config.sources[name], keep_ns) for name in used}
        imu = None if "imu" in config.without else config.imu
        self._imu = None if imu is None else imu_source_of(imu, keep_ns)
        self._trigger = trigger_of(config)
        self._triggers = {port: trigger_of(config) for port in _SEEN}
        self._T_odom_base = SE3.identity()  # the newest pose that the trigger was told
        self._builder: TrajectoryBuilder | None = None
        self._now_ns = -END
        self._due_ns: dict[str, int] = {}  # by input of measurements: when its next period begins
        self._begun_ns: int | None = None  # the stamp at which the next submap begins

    @classmethod
    def ports_for(cls, config: TrajectoryConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        types = {"odometry": Odometry, "wheel": WheelOdometry}
        inputs: dict[str, Any] = {
            name: types[source.kind]
            for name, source in config.sources.items()
            if source.kind in types
        }
        if config.imu is not None:
            inputs["imu"] = ImuBatch
        if config.clouds:
            inputs["clouds"] = PointCloud
        if config.n_frames:
            inputs["n_frames"] = NFrame
        return inputs | dict.fromkeys(config.constraints, Constraint), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        held_back = {
            name: receiver
            for name, receiver in inputs.items()
            if self._config.waits or name not in self._config.constraints
        }
        names = list(held_back)
        async with anyio.create_task_group() as tasks:
            for name in inputs.keys() - held_back.keys():
                tasks.start_soon(self._take_as_they_come, name, inputs[name])
            async for port, message in merge(*held_back.values(), keeps_late=True):
                self._begin(message.stamp_ns, held_back[names[port]].epoch)
                self.hear(names[port], message)
                for submap in self.due():
                    await outputs.submaps.send(submap)
                if outputs.predictions.is_connected and names[port] == self._pace:
                    await self._predict(outputs.predictions, message.stamp_ns)
        if self._builder is None:
            return
        for submap in self.due(END):
            await outputs.submaps.send(submap)
        for reason, count in self._builder.lost.items():
            for _ in range(count):
                report_loss(reason)

    async def _take_as_they_come(self, port: str, constraints: Receiver[Constraint]) -> None:
        async for constraint in constraints:
            self._begin(constraint.stamp_ns, constraints.epoch)
            self.hear(port, constraint)

    async def _predict(self, predictions: Sender[Odometry], stamp_ns: int) -> None:
        try:
            await predictions.send(self.builder.predict(stamp_ns))
        except EstimationError:
            predictions.advance(stamp_ns)  # before the first pose, and where all sources are silent

    @property
    def builder(self) -> TrajectoryBuilder:
        """The trajectory, once a message came.

        Raises:
            EstimationError: Before.
        """
        if self._builder is None:
            raise EstimationError("no message came yet")
        return self._builder

    def hear(self, port: str, message: Message) -> None:
        """Take one message in."""
        if port in self._config.without:
            return
        if isinstance(message, Constraint):
            if self._is_due(port, message.stamp_ns):
                self.builder.add(message)
        elif isinstance(message, PointCloud | NFrame):
            self._see(port, message)
        elif not self._add(port, message):
            report_loss(f"messages of {port} whose stamp does not increase")
            return
        if self._config.waits or not isinstance(message, Constraint):
            self._now_ns = max(self._now_ns, message.stamp_ns)
        if port == self._pace and port not in _SEEN:
            if isinstance(message, Odometry | WheelOdometry):
                self._T_odom_base = message.T_odom_base
            if self._trigger.fires(message.stamp_ns, self._T_odom_base):
                self.builder.ask(message.stamp_ns)

    def _is_due(self, port: str, stamp_ns: int) -> bool:
        """Return whether this is the input's first measurement in its period; periods follow each other.

        So there is one measurement in a period on average, whatever their rate.
        """
        period_ns = round(self._config.constraints[port].period_s * _SECOND_NS)
        if not period_ns:
            return True
        due_ns = self._due_ns.get(port, stamp_ns)
        if stamp_ns < due_ns:
            return False
        self._due_ns[port] = stamp_ns + period_ns - (stamp_ns - due_ns) % period_ns
        return True

    def due(self, known_ns: int | None = None) -> list[Submap]:
        """Return the submaps that are full; at the end all that is left."""
        known_ns = self._now_ns if known_ns is None else known_ns
        submaps = []
        while (last_ns := self._end_of_submap(known_ns)) is not None:
            submaps.append(self._commit(known_ns, last_ns))
            self._begun_ns = last_ns
        if known_ns >= END:
            submaps.append(self._commit(END, END))
        return [submap for submap in submaps if submap is not None]

    def _commit(self, known_ns: int, up_to_ns: int) -> Submap | None:
        T_base_imu = SE3.identity() if self._imu is None else self._imu.T_base_sensor
        self.builder.sensors = self._config.described(T_base_imu)
        return self.builder.commit(known_ns, up_to_ns=up_to_ns)

    def _end_of_submap(self, known_ns: int) -> int | None:
        """Return the stamp that makes the next submap full, None if it is not."""
        ready = self.builder.ready(known_ns)
        if not ready:
            return None
        begun_ns = ready[0] if self._begun_ns is None else self._begun_ns
        length_ns = round(self._config.submap_s * _SECOND_NS)
        for number, stamp_ns in enumerate(ready, 1):
            if stamp_ns - begun_ns >= length_ns or number == self._config.num_poses:
                return stamp_ns
        return None

    @property
    def _pace(self) -> str | None:
        """The input whose messages decide where poses are made that nothing asks for."""
        inputs, _ = self.ports_for(self._config)
        left_out = {*self._config.constraints, *self._config.without}
        candidates = [name for name in inputs if name not in left_out]
        return next((name for name in (*_SEEN, *candidates) if name in candidates), None)

    def _see(self, port: str, seen: PointCloud | NFrame) -> None:
        first = next(iter(self._sources.values()), None)
        if first is not None and first.covers(seen.stamp_ns, seen.stamp_ns):
            self._T_odom_base = first.state_at(seen.stamp_ns).T_odom_base
        if self._triggers[port].fires(seen.stamp_ns, self._T_odom_base):
            self.builder.see(seen)

    def _add(self, port: str, message: Message) -> bool:
        """Feed a source; return False if it is not newer than what it knows."""
        if isinstance(message, ImuBatch) and self._imu is not None:
            num_late = self._imu.add(message)
            return num_late < len(message.stamps_ns)
        source = self._sources[port]
        if source.span_ns is not None and message.stamp_ns <= source.span_ns[1]:
            return False
        if isinstance(source, WheelSource) and isinstance(message, WheelOdometry):
            source.add_wheels(message)
        elif isinstance(source, OdometrySource) and isinstance(message, Odometry):
            source.add(message)
        return True

    def _begin(self, stamp_ns: int, epoch: int) -> None:
        if self._builder is None:
            name = mission_id(f"{self._config.mission}@{stamp_ns}", epoch)
            window_s = self._config.window_s
            self._builder = TrajectoryBuilder(
                Links(name, self._sources, self._imu, bridge_of(self._config, self._sources)),
                window_ns=None if window_s is None else round(window_s * _SECOND_NS),
                num_common_tracks=self._config.num_common_tracks,
                keep_ns=round(self._config.late_s * _SECOND_NS),
            )
