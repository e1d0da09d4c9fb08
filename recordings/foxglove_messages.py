"""Messages of ours as Foxglove's, so that its viewer shows poses, clouds, images and fixes.

A viewer needs transforms between frames, so poses come with one. Covariances, rings and offsets that
Foxglove's schemas have no place for stay in our own messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Final

import numpy as np
from mcap_protobuf.schema import build_file_descriptor_set

from mapstream.recordings.decoding.foxglove import protobuf_class
from mapstream.recordings.recording import Channel
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import quat_xyzw_from_rotation
from mapstream.streams.messages.estimates import MapCorrection, Odometry, PointCloud
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    LidarScan,
    Message,
    TransformBatch,
    WheelOdometry,
)

_FLOAT32, _UINT16 = 7, 3  # foxglove.PackedElementField.NumericType
_APPROXIMATED: Final = 1  # foxglove.LocationFix.PositionCovarianceType
BASE, ODOM, MISSION = "base", "odom", "mission"


@cache
def foxglove_channel(topic: str, name: str) -> Channel:
    """Describe a topic of Foxglove messages."""
    descriptors = build_file_descriptor_set(protobuf_class(f"foxglove.{name}"))
    return Channel(
        topic=topic,
        message_encoding="protobuf",
        schema_name=f"foxglove.{name}",
        schema_encoding="protobuf",
        schema_data=bytes(descriptors.SerializeToString(deterministic=True)),
    )


def as_foxglove(topic: str, message: Message) -> Iterator[tuple[Channel, bytes]]:
    """Yield the channel and the bytes of each Foxglove message that shows one of ours; none for most."""
    for suffix, name, fields in _shown(message):
        made = protobuf_class(f"foxglove.{name}")(**fields)
        channel = foxglove_channel(f"{topic}{suffix}", name)
        yield channel, bytes(made.SerializeToString(deterministic=True))


def _shown(message: Message) -> Iterator[tuple[str, str, dict[str, Any]]]:  # a table of types
    if isinstance(message, (LidarScan, PointCloud)):
        yield "", "PointCloud", _cloud(message)
    elif isinstance(message, (Odometry, WheelOdometry)):
        yield from _pose(message)
    elif isinstance(message, MapCorrection):
        yield from _trajectory(message)
    elif isinstance(message, TransformBatch):
        yield "", "FrameTransforms", {"transforms": _transforms(message)}
    elif isinstance(message, CameraFrame):
        yield "", "RawImage", _image(message)
    elif isinstance(message, EncodedImage):
        fields = {"data": message.data.tobytes(), "format": message.format}
        yield "", "CompressedImage", _stamped(message.stamp_ns, message.frame) | fields
    elif isinstance(message, GnssFix):
        yield "", "LocationFix", _fix(message)


def _time(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return {"seconds": seconds, "nanos": nanoseconds}


def _stamped(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"timestamp": _time(stamp_ns), "frame_id": frame}


def _parts(T: FloatArray) -> tuple[dict[str, float], dict[str, float]]:
    """Return translation and rotation of a (4, 4) transform."""
    quat = quat_xyzw_from_rotation(T[:3, :3]).tolist()
    return dict(zip("xyz", T[:3, 3].tolist(), strict=True)), dict(zip("xyzw", quat, strict=True))


def _posed(T: FloatArray) -> dict[str, Any]:
    position, orientation = _parts(T)
    return {"position": position, "orientation": orientation}


def _transform(stamp_ns: int, parent: str, child: str, T: FloatArray) -> dict[str, Any]:
    translation, rotation = _parts(T)
    return {
        "timestamp": _time(stamp_ns),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": translation,
        "rotation": rotation,
    }


def _transforms(batch: TransformBatch) -> list[dict[str, Any]]:
    rows = zip(batch.stamps_ns.tolist(), batch.parents, batch.children, strict=True)
    return [_transform(*row, T) for row, T in zip(rows, batch.T_parent_child, strict=True)]


def _pose(message: Odometry | WheelOdometry) -> Iterator[tuple[str, str, dict[str, Any]]]:
    stamp_ns, T = message.stamp_ns, message.T_odom_base.matrix
    yield "", "PoseInFrame", _stamped(stamp_ns, ODOM) | {"pose": _posed(T)}
    yield "/transform", "FrameTransform", _transform(stamp_ns, ODOM, BASE, T)


def _trajectory(message: MapCorrection) -> Iterator[tuple[str, str, dict[str, Any]]]:
    stamp_ns, poses = message.stamp_ns, [_posed(T) for T in message.T_mission_base]
    yield "", "PosesInFrame", _stamped(stamp_ns, MISSION) | {"poses": poses}
    T_mission_odom = message.T_mission_odom.matrix
    yield "/transform", "FrameTransform", _transform(stamp_ns, MISSION, ODOM, T_mission_odom)


def _cloud(message: LidarScan | PointCloud) -> dict[str, Any]:
    columns: list[tuple[str, int, Any]] = [
        (axis, _FLOAT32, message.points[:, i]) for i, axis in enumerate("xyz")
    ]
    if message.intensity is not None:
        columns.append(("intensity", _FLOAT32, message.intensity))
    frame = message.frame if isinstance(message, LidarScan) else BASE
    if isinstance(message, LidarScan) and message.ring is not None:
        columns.append(("ring", _UINT16, message.ring))
    dtype = np.dtype([(name, column.dtype) for name, _, column in columns])
    points = np.empty(len(message.points), dtype)
    fields: list[dict[str, Any]] = []
    for name, kind, column in columns:
        offset = sum(dtype[field["name"]].itemsize for field in fields)
        fields.append({"name": name, "offset": offset, "type": kind})
        points[name] = column
    return _stamped(message.stamp_ns, frame) | {
        "pose": _posed(np.eye(4)),
        "point_stride": dtype.itemsize,
        "fields": fields,
        "data": points.tobytes(),
    }


def _image(message: CameraFrame) -> dict[str, Any]:
    pixels = np.ascontiguousarray(message.image)
    return _stamped(message.stamp_ns, message.frame) | {
        "width": pixels.shape[1],
        "height": pixels.shape[0],
        "encoding": message.encoding,
        "step": pixels.strides[0],
        "data": pixels.tobytes(),
    }


def _fix(message: GnssFix) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "latitude": message.latitude_deg,
        "longitude": message.longitude_deg,
        "altitude": message.altitude_m,
    }
    if message.covariance_enu_m2 is not None:
        fields["position_covariance"] = message.covariance_enu_m2.ravel().tolist()
        fields["position_covariance_type"] = _APPROXIMATED
    return _stamped(message.stamp_ns, message.frame) | fields
