"""Decoders: recorded messages of the usual schemas as messages of mapstream.

ROS 2 (CDR), ROS 1, Foxglove (protobuf, JSON), and mapstream's own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from mapstream.recordings import message_codec
from mapstream.recordings.decoding import foxglove, ros, ros_clouds, ros_images, ros_objects
from mapstream.recordings.decoding.cursor import CdrCursor, Ros1Cursor
from mapstream.recordings.decoding.decoder import Decoder, Parse
from mapstream.recordings.message_schema import PACKAGE
from mapstream.recordings.recording import Channel
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.estimates import Odometry
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

__all__ = ["Decoder", "decoder_for", "message_type_of"]

_Read = Callable[..., Any]  # of a cursor or a protobuf message; clouds also take the notices

# the first one of a name is what a topic decodes to; others are for who asks for their type
_ROS: list[tuple[str, type[Any], _Read]] = [
    ("sensor_msgs/Imu", ImuBatch, ros.imu),
    ("sensor_msgs/PointCloud2", LidarScan, ros_clouds.PointCloudReader),
    ("sensor_msgs/PointCloud2", OrganizedCloud, ros_clouds.OrganizedCloudReader),
    ("livox_ros_driver/CustomMsg", LidarScan, ros_clouds.livox),
    ("livox_ros_driver2/CustomMsg", LidarScan, ros_clouds.livox),
    ("sensor_msgs/Image", CameraFrame, ros_images.image),
    ("sensor_msgs/CompressedImage", EncodedImage, ros_images.compressed_image),
    ("sensor_msgs/CameraInfo", CameraCalibration, ros_images.camera_info),
    ("sensor_msgs/LaserScan", LaserScan2D, ros.laser_scan),
    ("sensor_msgs/NavSatFix", GnssFix, ros.nav_sat_fix),
    ("nav_msgs/Odometry", Odometry, ros.odometry),
    ("nav_msgs/Odometry", WheelOdometry, ros.wheel_odometry),
    ("maplab_msgs/OdometryWithImuBiases", Odometry, ros.odometry_with_biases),
    ("geometry_msgs/PoseStamped", Odometry, ros.pose),
    ("geometry_msgs/PoseWithCovarianceStamped", Odometry, ros.pose_with_covariance),
    ("tf2_msgs/TFMessage", TransformBatch, ros.transforms),
    ("tf/tfMessage", TransformBatch, ros.transforms),
    ("vision_msgs/Detection2DArray", ObjectDetections, ros_objects.detections_2d),
    ("vision_msgs/Detection3DArray", ObjectDetections, ros_objects.detections_3d),
]
_FOXGLOVE: list[tuple[str, type[Any], _Read]] = [
    ("foxglove.PointCloud", LidarScan, foxglove.point_cloud),
    ("foxglove.RawImage", CameraFrame, foxglove.raw_image),
    ("foxglove.CompressedImage", EncodedImage, foxglove.compressed_image),
    ("foxglove.CameraCalibration", CameraCalibration, foxglove.camera_calibration),
    ("foxglove.LocationFix", GnssFix, foxglove.location_fix),
    ("foxglove.LaserScan", LaserScan2D, foxglove.laser_scan),
    ("foxglove.PoseInFrame", Odometry, foxglove.pose_in_frame),
    ("foxglove.FrameTransform", TransformBatch, foxglove.frame_transform),
    ("foxglove.FrameTransforms", TransformBatch, foxglove.frame_transforms),
]
_ENCODINGS = "cdr, ros1, protobuf, json"


def decoder_for(channel: Channel, message_type: type[Any] | None = None) -> Decoder:
    """Return what decodes the messages of a channel.

    Args:
        channel: As the recording describes it.
        message_type: What to decode to where a schema offers several, such as `WheelOdometry`.

    Raises:
        DecodeError: If the schema or the encoding is not known, or does not give that type.
    """
    name, encoding = schema_key(channel), channel.message_encoding
    if encoding == "protobuf" and name.startswith(f"{PACKAGE}."):
        own_type, decode = message_codec.decoder(name, channel.schema_data)
        if message_type not in (None, own_type):
            raise _wrong_type(channel, [own_type], message_type)
        return Decoder(channel, own_type, decode)
    table = _FOXGLOVE if encoding in ("protobuf", "json") else _ROS
    found = [(t, read) for n, t, read in table if n == name]
    if encoding not in ("cdr", "ros1", "protobuf", "json"):
        raise DecodeError(
            f"{channel.topic}: message encoding {encoding!r} is not known; known: {_ENCODINGS}"
        )
    if not found:
        known = ", ".join(dict.fromkeys(n for n, _, _ in table))
        what = f"schema {name!r}" if name else "a channel without a schema"
        raise DecodeError(f"{channel.topic}: no decoder for {what} in {encoding}; known: {known}")
    matching = [pair for pair in found if message_type in (None, pair[0])]
    if not matching:
        raise _wrong_type(channel, [t for t, _ in found], message_type)
    found_type, read = matching[0]
    notices: Counter[str] = Counter()
    is_fast = found_type is ImuBatch and encoding == "cdr"
    return Decoder(
        channel=channel,
        message_type=found_type,
        parse=_parse(channel, _bound(channel, read, notices)),
        parse_many=ros.imu_batch if is_fast else None,
        notices=notices,
    )


def _wrong_type(channel: Channel, found: list[type[Any]], wanted: Any) -> DecodeError:  # noqa: ANN401
    given = ", ".join(kind.__name__ for kind in found)
    name = getattr(wanted, "__name__", wanted)
    return DecodeError(f"{channel.topic}: {schema_key(channel)} decodes to {given}, not to {name}")


def message_type_of(channel: Channel) -> type[Any] | None:
    """Return what a channel's messages decode to, or None where there is no decoder."""
    try:
        return decoder_for(channel).message_type
    except DecodeError:
        return None


def schema_key(channel: Channel) -> str:
    """Return a schema's name as ROS 1 writes it: `sensor_msgs/msg/Imu` is `sensor_msgs/Imu`."""
    return channel.schema_name.replace("/msg/", "/")


def _bound(channel: Channel, read: _Read, notices: Counter[str]) -> _Read:
    if read in (ros_clouds.PointCloudReader, ros_clouds.OrganizedCloudReader):
        return read(notices)
    if read in (ros_clouds.livox, foxglove.point_cloud):
        return partial(read, notices=notices)
    if read is ros.transforms:
        return partial(read, is_static=channel.topic.endswith("tf_static"))
    return read


def _parse(channel: Channel, read: _Read) -> Parse:
    encoding = channel.message_encoding
    if encoding == "cdr":
        return lambda data: read(CdrCursor(data))
    if encoding == "ros1":
        return lambda data: read(Ros1Cursor(data))
    protobuf = foxglove.protobuf_class(channel.schema_name)
    if encoding == "json":
        return lambda data: read(foxglove.from_json(protobuf(), data))
    return lambda data: read(protobuf.FromString(bytes(data)))
