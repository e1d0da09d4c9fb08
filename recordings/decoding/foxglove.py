"""Foxglove's schemas, in protobuf and in JSON, as messages of ours.

Definitions: https://docs.foxglove.dev/docs/visualization/message-schemas; compiled in the package
foxglove-schemas-protobuf. A JSON message is filled into the protobuf message of its name first, so that
each schema is read in one place.
"""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Mapping
from importlib import import_module
from typing import Any, Final

import numpy as np
from google.protobuf.message import Message as Protobuf

from mapstream.recordings.decoding.point_fields import (
    CloudSize,
    PointField,
    layout_of,
    points_view,
    scan_of,
)
from mapstream.recordings.decoding.ros_images import calibration_of, pixels_of
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    LaserScan2D,
    LidarScan,
    TransformBatch,
)

_POINT_TYPES: Final = (None, "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8")


def protobuf_class(name: str) -> type[Any]:
    """Return the compiled class of `foxglove.Name`."""
    bare = name.removeprefix("foxglove.")
    found: type[Any] = getattr(import_module(f"foxglove_schemas_protobuf.{bare}_pb2"), bare)
    return found


def from_json(message: Any, data: memoryview) -> Any:  # noqa: ANN401  # protobuf has no types
    """Fill a protobuf message from Foxglove's JSON: times as {sec, nsec}, bytes in base64."""
    content = json.loads(bytes(data))
    if not isinstance(content, Mapping):
        raise TypeError(f"expected a JSON object, found {type(content).__name__}")
    _fill(message, content)
    return message


def _fill(message: Protobuf, content: Mapping[str, Any]) -> None:
    for key, value in content.items():
        field = message.DESCRIPTOR.fields_by_name.get(key)
        if field is None and key in ("sec", "nsec"):  # of a time or duration
            field = message.DESCRIPTOR.fields_by_name["seconds" if key == "sec" else "nanos"]
        if field is None or value is None:
            continue  # a newer version of the schema
        target = getattr(message, field.name)
        if field.is_repeated:
            for item in value:
                if field.message_type is None:
                    target.append(item)
                else:
                    _fill(target.add(), item)
        elif field.message_type is not None:
            target.SetInParent()
            _fill(target, value)
        else:
            is_bytes = field.type == field.TYPE_BYTES
            setattr(message, field.name, base64.b64decode(value) if is_bytes else value)


def _stamp_ns(message: Any) -> int:  # noqa: ANN401
    return int(message.timestamp.seconds) * 10**9 + int(message.timestamp.nanos)


def _transform(translation: Any, rotation: Any) -> SE3:  # noqa: ANN401
    quat = (rotation.x, rotation.y, rotation.z, rotation.w)
    if not any(quat):  # an unset message: no rotation
        quat = (0.0, 0.0, 0.0, 1.0)
    return SE3.from_quat_xyzw(quat, (translation.x, translation.y, translation.z))


def point_cloud(message: Any, notices: Counter[str]) -> LidarScan:  # noqa: ANN401
    """Read a foxglove.PointCloud; its pose in the frame is applied."""
    for field in message.fields:
        if not 0 < field.type < len(_POINT_TYPES):
            raise ValueError(f"point field {field.name} has the unknown type {field.type}")
    fields = tuple(PointField(f.name, str(_POINT_TYPES[f.type]), f.offset) for f in message.fields)
    layout = layout_of(fields, message.point_stride)
    data = memoryview(message.data)
    count = len(data) // message.point_stride
    points = points_view(data, layout, CloudSize(1, count, 0))
    scan = scan_of(
        points, layout, stamp_ns=_stamp_ns(message), frame=message.frame_id, notices=notices
    )
    pose = _transform(message.pose.position, message.pose.orientation)
    if np.array_equal(pose.matrix, np.eye(4)):
        return scan
    moved = (pose @ scan.points).astype(np.float32)
    if not np.isfinite(moved).all():
        raise ValueError(f"its pose is out of all reach: {pose}")
    return LidarScan(
        stamp_ns=scan.stamp_ns,
        points=moved,
        intensity=scan.intensity,
        ring=scan.ring,
        offsets_ns=scan.offsets_ns,
        frame=scan.frame,
    )


def raw_image(message: Any) -> CameraFrame:  # noqa: ANN401
    """Read a foxglove.RawImage."""
    pixels, encoding = pixels_of(
        np.frombuffer(message.data, np.uint8),
        message.encoding,
        shape=(message.height, message.width),
        row_bytes=message.step,
    )
    return CameraFrame(
        stamp_ns=_stamp_ns(message),
        image=pixels,
        encoding=encoding,
        frame=message.frame_id or "camera",
    )


def compressed_image(message: Any) -> EncodedImage:  # noqa: ANN401
    """Read a foxglove.CompressedImage."""
    return EncodedImage(
        stamp_ns=_stamp_ns(message),
        data=np.frombuffer(message.data, np.uint8),
        format="jpeg" if message.format == "jpg" else message.format,
        frame=message.frame_id or "camera",
    )


def camera_calibration(message: Any) -> CameraCalibration:  # noqa: ANN401
    """Read a foxglove.CameraCalibration."""
    return calibration_of(
        message.distortion_model,
        np.array(message.D, np.float64),
        np.array(message.K, np.float64),
        size_px=(message.width, message.height),
        stamp_ns=_stamp_ns(message),
        frame=message.frame_id,
    )


def location_fix(message: Any) -> GnssFix:  # noqa: ANN401
    """Read a foxglove.LocationFix."""
    covariance = np.array(message.position_covariance, np.float64)
    is_known = message.position_covariance_type != 0 and covariance.size == 9
    return GnssFix(
        stamp_ns=_stamp_ns(message),
        latitude_deg=message.latitude,
        longitude_deg=message.longitude,
        altitude_m=message.altitude,
        covariance_enu_m2=covariance.reshape(3, 3) if is_known else None,
        frame=message.frame_id or "gnss",
    )


def laser_scan(message: Any) -> LaserScan2D:  # noqa: ANN401
    """Read a foxglove.LaserScan; it has no range limits, so only numbers above zero count."""
    ranges = np.array(message.ranges, np.float32)
    ranges[~(np.isfinite(ranges) & (ranges > 0))] = np.nan
    steps = max(len(ranges) - 1, 1)
    has_intensity = len(message.intensities) == len(ranges)
    return LaserScan2D(
        stamp_ns=_stamp_ns(message),
        ranges_m=ranges,
        angle_min_rad=message.start_angle,
        angle_step_rad=(message.end_angle - message.start_angle) / steps,
        range_min_m=0.0,
        range_max_m=float("inf"),
        intensity=np.array(message.intensities, np.float32) if has_intensity else None,
        frame=message.frame_id or "laser",
    )


def pose_in_frame(message: Any) -> Odometry:  # noqa: ANN401
    """Read a foxglove.PoseInFrame as the pose of the base."""
    pose = _transform(message.pose.position, message.pose.orientation)
    return Odometry(stamp_ns=_stamp_ns(message), T_odom_base=pose)


def frame_transform(message: Any) -> TransformBatch:  # noqa: ANN401
    """Read a foxglove.FrameTransform."""
    return _transforms([message])


def frame_transforms(message: Any) -> TransformBatch:  # noqa: ANN401
    """Read a foxglove.FrameTransforms."""
    return _transforms(list(message.transforms))


def _transforms(found: list[Any]) -> TransformBatch:
    matrices = [_transform(t.translation, t.rotation).matrix for t in found]
    return TransformBatch(
        stamps_ns=np.array([_stamp_ns(t) for t in found], np.int64),
        parents=tuple(t.parent_frame_id for t in found),
        children=tuple(t.child_frame_id for t in found),
        T_parent_child=np.array(matrices).reshape(-1, 4, 4),
    )
