"""What a graph file says of a recording that it plays."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, field_validator

from mapstream.operators.images.calibrated import WrongSize
from mapstream.operators.operator import OperatorConfig, OptionalPath
from mapstream.recordings.message_codec import known_messages
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.messages.constraints import Constraint, LoopClosure
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    ImuBatch,
    LaserScan2D,
    LidarScan,
    OrganizedCloud,
    TransformBatch,
    WheelOdometry,
)

_TYPES: dict[str, type[Any]] = {  # by the name of a port
    "scans": LidarScan,
    "organized": OrganizedCloud,
    "imu": ImuBatch,
    "frames": CameraFrame,
    "images": EncodedImage,
    "odometry": Odometry,
    "wheels": WheelOdometry,
    "fixes": GnssFix,
    "laser": LaserScan2D,
    "clouds": PointCloud,
    "transforms": TransformBatch,
    "calibrations": CameraCalibration,
    "constraints": Constraint,
    "loops": LoopClosure,
    "biases": ImuBatch,
    "detections": ObjectDetections,
}


def check_message_name(name: str | None) -> str | None:
    """Refuse names of messages that do not exist.

    Raises:
        ValueError: With the known names.
    """
    known = known_messages()
    if name is not None and name not in known:
        raise ValueError(f"no message {name!r}; known: {', '.join(sorted(known))}")
    return name


class TopicConfig(OperatorConfig):
    topic: str
    type: str | None = Field(
        default=None, description="the message, where the port's name does not say: LidarScan, ..."
    )
    offset_s: float = Field(default=0.0, description="added to all stamps: a fixed delay")
    stamp: Literal["header", "log"] = Field(default="header", description="which time is the stamp")
    frame: str | None = Field(
        default=None, description="the sensor's frame, if not the recorded one"
    )

    calibration: str | None = Field(
        default=None,
        description="of a camera's images: the topic that describes the camera, where it is not found"
        " in the sensor file or beside the images",
    )

    _check_type = field_validator("type")(check_message_name)


class McapSourceConfig(OperatorConfig):
    path: Path = Field(description="an .mcap, .bag or .db3 file, or a rosbag2 folder")
    topics: dict[str, str | TopicConfig] = Field(
        description="port: topic, or port: {topic, type, offset_s, stamp, frame, calibration}"
    )
    rig: OptionalPath = Field(
        default=None,
        description="a sensor file: places, frames, time offsets; the one in the recording, if it has one",
    )
    base_frame: str | None = Field(
        default=None, description="the robot's frame on `transforms`; the rig's, or base_link"
    )
    transforms: tuple[str, ...] = Field(
        default=("/tf", "/tf_static"),
        description="topics that say where sensors sit, if they exist",
    )
    start_s: NonNegativeFloat = Field(default=0.0, description="where to begin, after the start")
    end_s: PositiveFloat | None = Field(default=None, description="where to stop, after the start")
    imu_batch_s: PositiveFloat = Field(
        default=0.05, description="IMU samples of this much log time make one message"
    )
    lateness_s: NonNegativeFloat = Field(
        default=0.2, description="how much more than usual a message may lag behind its log time"
    )
    max_jump_s: PositiveFloat = Field(
        default=5.0, description="a clock that jumps farther starts a new epoch"
    )
    on_wrong_size: WrongSize = Field(
        default="drop",
        description="what to do with images that are not of their calibration's size: drop them, or"
        " rescale the calibration",
    )
    on_error: Literal["skip", "stop"] = Field(
        default="skip", description="what to do with messages that cannot be decoded"
    )

    @field_validator("topics")
    @classmethod
    def _check_topics(cls, topics: dict[str, str | TopicConfig]) -> dict[str, str | TopicConfig]:
        if not topics:
            raise ValueError("no topics; give at least one, such as {scans: /points}")
        return topics

    def topic(self, port: str) -> TopicConfig:
        """Return what a port reads, in full."""
        entry = self.topics[port]
        return TopicConfig(topic=entry) if isinstance(entry, str) else entry

    def message_type(self, port: str) -> Any:  # noqa: ANN401  # Any where nothing says it
        """Return the type of a port."""
        return type_of_port(port, self.topic(port).type)


def type_of_port(port: str, given: str | None) -> Any:  # noqa: ANN401
    """Return a message type as given, or by the port's name (`scans`, `scans_front`); Any otherwise."""
    if given is not None:
        return known_messages()[given]
    return next((t for name, t in _TYPES.items() if f"{port}_".startswith(f"{name}_")), Any)
