"""ROS messages of detected objects, serialized by rosbags, for tests of their decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from mapstream.recordings.recording import RawMessage
from tests.recordings.decoding import made_ros

_RULE = "=" * 80
_HYPOTHESIS = {
    "cdr": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "ros1": "int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
}
_CENTER = {"cdr": "vision_msgs/Pose2D center", "ros1": "geometry_msgs/Pose2D center"}
_REST_2D = {"cdr": "string id", "ros1": "sensor_msgs/Image source_img"}
_REST_3D = {"cdr": "string id", "ros1": "sensor_msgs/PointCloud2 source_cloud"}


@dataclass(frozen=True)
class Thing:
    """A detection, with the classes that it may be and how likely each is."""

    classes: Sequence[tuple[str, float]]
    box: tuple[float, ...]  # x, y, angle, width, height [px]; or x, y, z, sides [m]
    quat_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of a detection in an image
    track: str = ""


@cache
def _register(encoding: str) -> None:
    parts = {
        "ObjectHypothesis": "string class_id\nfloat64 score",
        "ObjectHypothesisWithPose": _HYPOTHESIS[encoding],
        "Point2D": "float64 x\nfloat64 y",
        "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
        "BoundingBox2D": f"{_CENTER[encoding]}\nfloat64 size_x\nfloat64 size_y",
        "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    }
    for d in ("2D", "3D"):
        rest = (_REST_2D if d == "2D" else _REST_3D)[encoding]
        parts[f"Detection{d}"] = (
            f"std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            f"vision_msgs/BoundingBox{d} bbox\n{rest}"
        )
        parts[f"Detection{d}Array"] = (
            f"std_msgs/Header header\nvision_msgs/Detection{d}[] detections"
        )
    store = made_ros.store(encoding)
    for name, text in parts.items():
        store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))


def detections(
    encoding: str, dimensions: str, things: Sequence[Thing], frame: str = "left"
) -> RawMessage:
    """Make a vision_msgs/Detection2DArray or Detection3DArray."""
    _register(encoding)
    header = made_ros.header(encoding, frame)
    message = made_ros.make(
        encoding,
        f"vision_msgs/Detection{dimensions}Array",
        header=header,
        detections=[_detection(encoding, dimensions, thing, header) for thing in things],
    )
    return made_ros.raw(encoding, f"vision_msgs/Detection{dimensions}Array", message, "/objects")


def _detection(encoding: str, dimensions: str, thing: Thing, header: object) -> Any:  # noqa: ANN401
    make = made_ros.make
    results = []
    for name, score in thing.classes:
        pose = make(
            encoding,
            "geometry_msgs/PoseWithCovariance",
            pose=_pose(encoding, thing.place, thing.quat_xyzw),
            covariance=np.zeros(36),
        )
        if encoding == "ros1":
            said: dict[str, object] = {"id": int(name), "score": score}
        else:
            said = {"hypothesis": make(encoding, "vision_msgs/ObjectHypothesis", class_id=name, score=score)}  # fmt: skip
        results.append(make(encoding, "vision_msgs/ObjectHypothesisWithPose", **said, pose=pose))
    box = (_box_2d if dimensions == "2D" else _box_3d)(encoding, thing)
    rest: dict[str, object] = {"id": thing.track}
    if encoding == "ros1":
        rest = _source_image(header) if dimensions == "2D" else _source_cloud(header)
    name = f"vision_msgs/Detection{dimensions}"
    return make(encoding, name, header=header, results=results, bbox=box, **rest)


def _box_2d(encoding: str, thing: Thing) -> Any:  # noqa: ANN401
    x, y, angle, width, height = thing.box
    if encoding == "ros1":
        center = made_ros.make(encoding, "geometry_msgs/Pose2D", x=x, y=y, theta=angle)
    else:
        position = made_ros.make(encoding, "vision_msgs/Point2D", x=x, y=y)
        center = made_ros.make(encoding, "vision_msgs/Pose2D", position=position, theta=angle)
    return made_ros.make(
        encoding, "vision_msgs/BoundingBox2D", center=center, size_x=width, size_y=height
    )


def _box_3d(encoding: str, thing: Thing) -> Any:  # noqa: ANN401
    center = _pose(encoding, thing.box[:3], thing.quat_xyzw)
    size = made_ros.vector(encoding, *_three(thing.box[3:]))
    return made_ros.make(encoding, "vision_msgs/BoundingBox3D", center=center, size=size)


def _pose(encoding: str, place: Sequence[float], quat_xyzw: Sequence[float]) -> Any:  # noqa: ANN401
    return made_ros.make(
        encoding,
        "geometry_msgs/Pose",
        position=made_ros.vector(encoding, *_three(place), "Point"),
        orientation=made_ros.quaternion(encoding, *quat_xyzw),
    )


def _three(numbers: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = numbers
    return x, y, z


def _source_image(header: object) -> dict[str, object]:
    image = made_ros.make(
        "ros1",
        "sensor_msgs/Image",
        header=header,
        height=1,
        width=3,
        encoding="mono8",
        is_bigendian=0,
        step=3,
        data=np.arange(3, dtype=np.uint8),
    )
    return {"source_img": image}


def _source_cloud(header: object) -> dict[str, object]:
    field = made_ros.make("ros1", "sensor_msgs/PointField", name="x", offset=0, datatype=7, count=1)
    cloud = made_ros.make(
        "ros1",
        "sensor_msgs/PointCloud2",
        header=header,
        height=1,
        width=1,
        fields=[field],
        is_bigendian=False,
        point_step=4,
        row_step=4,
        data=np.zeros(4, np.uint8),
        is_dense=True,
    )
    return {"source_cloud": cloud}
