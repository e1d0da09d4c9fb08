"""ROS messages, serialized by rosbags in both encodings, for tests of the decoders."""

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapstream.recordings.recording import Channel, RawMessage

STAMP_NS = 1_700_000_000_123_456_789
_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


@cache
def store(encoding: str) -> Any:  # noqa: ANN401  # rosbags makes its classes at run time
    """Return the definitions of ROS 2 Humble (cdr) or ROS 1 Noetic (ros1)."""
    found = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
    if encoding == "ros1":  # rosbags has it for ROS 2 alone
        text = "geometry_msgs/TransformStamped[] transforms"
        found.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    found.register(get_types_from_msg(_LIVOX, "livox_ros_driver2/msg/CustomMsg"))
    return found


def make(encoding: str, name: str, /, **fields: object) -> Any:  # noqa: ANN401
    """Make a message of a type such as `sensor_msgs/Imu`."""
    return store(encoding).types[name.replace("/", "/msg/")](**fields)


def header(encoding: str, frame: str = "sensor", stamp_ns: int = STAMP_NS) -> Any:  # noqa: ANN401
    """Make a std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    time = make(encoding, "builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)
    sequence = {"seq": 5} if encoding == "ros1" else {}
    return make(encoding, "std_msgs/Header", **sequence, stamp=time, frame_id=frame)


def raw(encoding: str, name: str, message: object, topic: str = "/topic") -> RawMessage:
    """Serialize a message as a recording holds it."""
    full = name.replace("/", "/msg/")
    serialize = getattr(store(encoding), f"serialize_{encoding}")
    channel = Channel(topic=topic, message_encoding=encoding, schema_name=full)
    return RawMessage(channel, STAMP_NS, STAMP_NS, 0, memoryview(bytes(serialize(message, full))))


def vector(encoding: str, x: float, y: float, z: float, name: str = "Vector3") -> Any:  # noqa: ANN401
    return make(encoding, f"geometry_msgs/{name}", x=x, y=y, z=z)


def quaternion(encoding: str, *xyzw: float) -> Any:  # noqa: ANN401
    x, y, z, w = xyzw
    return make(encoding, "geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def pose(encoding: str) -> Any:  # noqa: ANN401
    """A pose at 1 2 3, turned by 90 degrees about z."""
    half = float(np.sqrt(0.5))
    return make(
        encoding,
        "geometry_msgs/Pose",
        position=vector(encoding, 1.0, 2.0, 3.0, "Point"),
        orientation=quaternion(encoding, 0.0, 0.0, half, half),
    )


def imu(encoding: str, k: int = 0, frame: str = "imu_link") -> RawMessage:
    message = make(
        encoding,
        "sensor_msgs/Imu",
        header=header(encoding, frame, STAMP_NS + k),
        orientation=quaternion(encoding, 0.0, 0.0, 0.0, 1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(encoding, 0.1 + k, 0.2, 0.3),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(encoding, 1.0, 2.0, 9.8 + k),
        linear_acceleration_covariance=np.zeros(9),
    )
    return raw(encoding, "sensor_msgs/Imu", message, "/imu")


_TYPES = {"i1": 1, "u1": 2, "<i2": 3, "<u2": 4, "<i4": 5, "<u4": 6, "<f4": 7, "<f8": 8}


def cloud(encoding: str, points: np.ndarray, /, **fields: object) -> RawMessage:
    """A sensor_msgs/PointCloud2 of a structured array."""
    layout: Any = points.dtype.fields or {}
    point_fields = [
        make(encoding, "sensor_msgs/PointField", name=name, offset=at, count=1,
             datatype=_TYPES[dtype.str.replace("|", "")])
        for name, (dtype, at, *_) in layout.items()
    ]  # fmt: skip
    given = {
        "header": header(encoding, "os_lidar"),
        "height": 1,
        "width": len(points),
        "fields": point_fields,
        "is_bigendian": False,
        "point_step": points.dtype.itemsize,
        "row_step": points.nbytes,
        "data": np.frombuffer(points.tobytes(), np.uint8),
        "is_dense": True,
    }
    message = make(encoding, "sensor_msgs/PointCloud2", **(given | fields))
    return raw(encoding, "sensor_msgs/PointCloud2", message, "/points")
