"""The sensors of one robot, where they sit, and which of them is meant."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import TransformBatch
from mapstream.streams.sensors import (
    CameraRigSensor,
    CameraSensor,
    FeatureSensor,
    Sensor,
    SensorKind,
)
from mapstream.streams.transforms import TransformTree

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Extrinsics:
    """Where a sensor sits, seen from its base sensor."""

    sensor_id: str
    base_sensor_id: str
    T_base_sensor: SE3


class Rig:
    """A set of sensors and the tree of their places.

    `transforms` holds the places that the rig's file fixes. What `/tf` says is added to it, for frames
    that the file leaves open; functions of time are given with `transforms.add_function`.
    """

    def __init__(
        self,
        sensors: Sequence[Sensor] = (),
        extrinsics: Sequence[Extrinsics] = (),
        base_frame: str = "",
    ) -> None:
        """Check and join the parts.

        Args:
            sensors: All sensors; cameras of a camera rig only within it.
            extrinsics: Their places.
            base_frame: The frame that maps are made of; by default that of the base sensor, or
                `base` where there is none.

        Raises:
            ConfigError: If an id occurs twice or is unknown, or there is more than one base.
            TransformError: If the places contradict each other.
        """
        self.sensors = tuple(sensors)
        self.extrinsics = tuple(extrinsics)
        self.transforms = TransformTree()
        self._by_id: dict[str, Sensor] = {}
        for sensor in self._all():
            if sensor.id in self._by_id:
                raise ConfigError(f"two sensors have the id {sensor.id}")
            self._by_id[sensor.id] = sensor
        self._place()
        self._fixed = frozenset(f for f in self.transforms.frames if self.transforms.parent_of(f))
        self.base_frame = base_frame or self._base_frame()

    def _all(self) -> Iterator[Sensor]:
        for sensor in self.sensors:
            yield sensor
            if isinstance(sensor, CameraRigSensor):
                yield from (mount.camera for mount in sensor.mounts)

    def _place(self) -> None:
        for place in self.extrinsics:
            base, sensor = self.sensor(place.base_sensor_id), self.sensor(place.sensor_id)
            if base is not sensor:
                self.transforms.add_static(base.node, sensor.node, place.T_base_sensor)
        for rig in self.sensors:
            if isinstance(rig, CameraRigSensor):
                for mount in rig.mounts:
                    self.transforms.add_static(rig.node, mount.camera.node, mount.T_rig_camera)
            elif isinstance(rig, FeatureSensor):
                self.sensor(rig.target_sensor_id)

    def _base_frame(self) -> str:
        bases = {self.sensor(place.base_sensor_id) for place in self.extrinsics}
        roots = sorted(b.node for b in bases if self.transforms.parent_of(b.node) is None)
        if len(roots) > 1:
            raise ConfigError(f"the sensors hang on more than one base: {', '.join(roots)}")
        return roots[0] if roots else "base"

    def sensor(self, sensor_id: str) -> Sensor:
        """Return a sensor by its id.

        Raises:
            ConfigError: If there is none.
        """
        if sensor_id not in self._by_id:
            known = ", ".join(self._by_id) or "none at all"
            raise ConfigError(f"no sensor has the id {sensor_id!r}; known: {known}")
        return self._by_id[sensor_id]

    def select(self, kind: SensorKind, sensor_id: str | None = None) -> Sensor:
        """Return the one sensor of a kind that is meant; others are ignored, and the log says so.

        Raises:
            ConfigError: If there is none of the kind, or several and no id tells which.
        """
        candidates = [sensor for sensor in self._by_id.values() if sensor.kind == kind]
        names = ", ".join(f"{s.id} ({s.description or s.topic})" for s in candidates)
        chosen = [s for s in candidates if sensor_id in (None, s.id)]
        if len(chosen) != 1:
            problem = f"{len(candidates)} sensors of kind {kind}"
            wanted = "say which by its id" if sensor_id is None else f"none has the id {sensor_id}"
            raise ConfigError(f"{problem}, {wanted}; there are: {names or 'none'}")
        for ignored in candidates:
            if ignored is not chosen[0]:
                _log.info("%s %s (%s) is ignored", kind, ignored.id, ignored.topic)
        return chosen[0]

    def sensor_of_topic(self, topic: str) -> Sensor | None:
        """Return the sensor that speaks on a topic, or None if the rig does not say."""
        return next((s for s in self._by_id.values() if s.topic and s.topic == topic), None)

    def camera_of_frame(self, frame: str) -> CameraSensor | None:
        """Return the camera with a name on `/tf`, or None if the rig does not say."""
        cameras = (s for s in self._by_id.values() if isinstance(s, CameraSensor))
        return next((camera for camera in cameras if camera.node == frame), None)

    def frame_of(self, sensor: Sensor) -> str:
        """Return the frame that a sensor's messages are in: features are in that of their camera.

        Raises:
            ConfigError: If the sensor is of another rig.
        """
        if isinstance(sensor, FeatureSensor):
            return self.sensor(sensor.target_sensor_id).node
        return sensor.node

    def add_transforms(self, batch: TransformBatch) -> None:
        """Take what `/tf` says of frames whose place the rig's file does not fix.

        Raises:
            TransformError: If it contradicts what was said before.
        """
        self.transforms.add(batch, except_children=self._fixed)

    def T_base_sensor(self, sensor_id_or_frame: str, stamp_ns: int) -> SE3:
        """Return where a sensor sits on the robot at a time.

        Raises:
            TransformError: If that is not known.
        """
        sensor = self._by_id.get(sensor_id_or_frame)
        frame = sensor_id_or_frame if sensor is None else sensor.node
        if frame == self.base_frame:
            return SE3.identity()
        return self.transforms.look_up(self.base_frame, frame, stamp_ns)
