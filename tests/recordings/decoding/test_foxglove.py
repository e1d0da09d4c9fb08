"""Foxglove's schemas: protobuf and JSON of the same message decode to the same."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.decoding.foxglove import protobuf_class
from mapstream.recordings.recording import Channel, RawMessage
from mapstream.streams.errors import DecodeError

_TIME = {"sec": 1_700_000_000, "nsec": 5}
_STAMP_NS = 1_700_000_000_000_000_005
_POINTS = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
_POINTS["x"], _POINTS["t"] = [1, 2, 3], [0, 10, 20]
_POSE = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 1, "w": 1}}
_MESSAGES: dict[str, dict[str, Any]] = {
    "PointCloud": {
        "timestamp": _TIME,
        "frame_id": "lidar",
        "pose": _POSE,
        "point_stride": 16,
        "fields": [
            {"name": "x", "offset": 0, "type": 7},
            {"name": "y", "offset": 4, "type": 7},
            {"name": "z", "offset": 8, "type": 7},
            {"name": "t", "offset": 12, "type": 5},
        ],
        "data": _POINTS.tobytes(),
    },
    "RawImage": {
        "timestamp": _TIME, "frame_id": "cam", "width": 2, "height": 1, "encoding": "mono8",
        "step": 2, "data": b"\x07\x08",
    },
    "CompressedImage": {"timestamp": _TIME, "frame_id": "cam", "format": "jpeg", "data": b"\xff\xd8"},
    "LocationFix": {
        "timestamp": _TIME, "frame_id": "gps", "latitude": 47.0, "longitude": 8.0, "altitude": 400.0,
        "position_covariance": [1, 0, 0, 0, 2, 0, 0, 0, 3], "position_covariance_type": 2,
    },
    "LaserScan": {
        "timestamp": _TIME, "frame_id": "laser", "start_angle": -1.0, "end_angle": 1.0,
        "ranges": [1.0, 0.0, 3.0], "intensities": [],
    },
    "CameraCalibration": {
        "timestamp": _TIME, "frame_id": "cam", "width": 4, "height": 2, "D": [],
        "distortion_model": "plumb_bob", "K": [9, 0, 2, 0, 8, 1, 0, 0, 1],
    },
    "PoseInFrame": {"timestamp": _TIME, "frame_id": "odom", "pose": _POSE},
    "FrameTransform": {
        "timestamp": _TIME, "parent_frame_id": "base", "child_frame_id": "lidar",
        "translation": _POSE["position"], "rotation": _POSE["orientation"],
    },
    "FrameTransforms": {
        "transforms": [
            {"timestamp": _TIME, "parent_frame_id": "base", "child_frame_id": "lidar",
             "translation": _POSE["position"], "rotation": _POSE["orientation"]},
        ]
    },
}  # fmt: skip


def _plain(value: object) -> object:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list) else value


def _protobuf(name: str) -> bytes:
    def renamed(value: object) -> object:
        if isinstance(value, Mapping):
            names = {"sec": "seconds", "nsec": "nanos"}
            return {names.get(key, key): renamed(item) for key, item in value.items()}
        return [renamed(item) for item in value] if isinstance(value, list) else value

    content = renamed(_MESSAGES[name])
    assert isinstance(content, dict)
    return bytes(protobuf_class(f"foxglove.{name}")(**content).SerializeToString())


def _decode(name: str, encoding: str) -> Any:  # noqa: ANN401
    channel = Channel(topic="/x", message_encoding=encoding, schema_name=f"foxglove.{name}")
    data = (
        _protobuf(name) if encoding == "protobuf" else json.dumps(_plain(_MESSAGES[name])).encode()
    )
    return decoder_for(channel)(RawMessage(channel, 1, 1, 0, memoryview(data)))


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize("name", _MESSAGES)
def test_each_schema_decodes_with_its_stamp(name: str, encoding: str) -> None:
    assert _decode(name, encoding).stamp_ns == _STAMP_NS


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_contents(encoding: str) -> None:
    cloud = _decode("PointCloud", encoding)
    np.testing.assert_allclose(cloud.points, [[1, 3, 3], [1, 4, 3], [1, 5, 3]], atol=1e-6)
    assert cloud.offsets_ns.tolist() == [0, 10, 20]
    assert _decode("RawImage", encoding).image.tolist() == [[7, 8]]
    assert _decode("CompressedImage", encoding).data.tolist() == [0xFF, 0xD8]
    fix = _decode("LocationFix", encoding)
    assert (fix.latitude_deg, fix.covariance_enu_m2[2, 2]) == (47.0, 3.0)
    scan = _decode("LaserScan", encoding)
    np.testing.assert_array_equal(scan.ranges_m, [1, np.nan, 3])
    assert scan.angle_step_rad == 1.0
    for matrix in (
        _decode("PoseInFrame", encoding).T_odom_base.matrix,
        _decode("FrameTransform", encoding).T_parent_child[0],
        _decode("FrameTransforms", encoding).T_parent_child[0],
    ):
        np.testing.assert_allclose(
            matrix[:3], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-9
        )


@pytest.mark.parametrize(
    ("encoding", "data"), [("json", b"{nonsense"), ("json", b"[1]"), ("protobuf", b"\xff\xff\xff")]
)
def test_damaged_messages_are_decode_errors(encoding: str, data: bytes) -> None:
    channel = Channel(topic="/x", message_encoding=encoding, schema_name="foxglove.PointCloud")

    with pytest.raises(DecodeError, match=r"/x: foxglove.PointCloud at log time 1"):
        decoder_for(channel)(RawMessage(channel, 1, 1, 0, memoryview(data)))
