"""Point clouds of every vendor come out as one kind of scan."""

from typing import Any

import numpy as np
import pytest

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import RawMessage
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.sensors import LidarScan
from tests.recordings.decoding.made_ros import STAMP_NS, cloud, header, make, raw

_N = 40
_OFFSETS_NS = np.arange(_N) * 1_000_000  # 40 ms
_ABSOLUTE_S = (STAMP_NS + _OFFSETS_NS) / 1e9
_LAYOUTS: dict[str, tuple[list[Any], str, str | None, Any]] = {
    "ouster": (
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "V4"), ("intensity", "<f4"), ("t", "<u4"),
         ("reflectivity", "<u2"), ("ring", "<u2"), ("ambient", "<u2"), ("range", "<u4")],
        "ring", "t", _OFFSETS_NS,
    ),
    "velodyne": (
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"),
         ("time", "<f4")],
        "ring", "time", _OFFSETS_NS / 1e9,
    ),
    "hesai": (
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("timestamp", "<f8"),
         ("ring", "<u2")],
        "ring", "timestamp", _ABSOLUTE_S,
    ),
    "robosense": (
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"),
         ("timestamp", "<f8")],
        "ring", "timestamp", _ABSOLUTE_S,
    ),
    "livox": (
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("tag", "u1"),
         ("line", "u1"), ("timestamp", "<f8")],
        "line", "timestamp", (STAMP_NS + _OFFSETS_NS).astype(float),
    ),
    "livox_offsets": (
        [("offset_time", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("reflectivity", "u1"),
         ("line", "u1")],
        "line", "offset_time", _OFFSETS_NS,
    ),
    "double": (
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4"), ("ring", "u1"),
         ("time", "<f8")],
        "ring", "time", _OFFSETS_NS / 1e9,
    ),
}  # fmt: skip


def _points(vendor: str) -> np.ndarray:
    fields, ring, time, times = _LAYOUTS[vendor]
    points = np.zeros(_N, np.dtype(fields))
    for k, name in enumerate("xyz"):
        points[name] = np.arange(_N) + k
    points["reflectivity" if vendor == "livox_offsets" else "intensity"] = np.arange(_N)
    points[ring] = np.arange(_N) % 16
    points[time] = times
    return points[[name for name in points.dtype.names or () if name != "_"]]


def _decode(message: RawMessage) -> LidarScan:
    scan = decoder_for(message.channel)(message)
    assert isinstance(scan, LidarScan)
    return scan


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("vendor", _LAYOUTS)
def test_A5_layouts_of_vendors_decode_to_one_schema(vendor: str, encoding: str) -> None:
    scan = _decode(cloud(encoding, _points(vendor)))

    np.testing.assert_array_equal(scan.points, np.arange(_N)[:, None] + [0, 1, 2])
    assert scan.points.dtype == np.float32
    assert scan.points.flags.c_contiguous
    assert scan.intensity is not None
    np.testing.assert_array_equal(scan.intensity, np.arange(_N))
    assert scan.ring is not None
    np.testing.assert_array_equal(scan.ring, np.arange(_N) % 16)
    assert scan.offsets_ns is not None  # float64 seconds since 1970 resolve 240 ns
    np.testing.assert_allclose(scan.offsets_ns, _OFFSETS_NS, atol=300)
    assert (scan.stamp_ns, scan.frame) == (STAMP_NS, "os_lidar")


def test_A5_missing_fields_are_reported_not_crashed() -> None:
    only_xyz = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    no_z = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("intensity", "<f4")])

    scan = _decode(cloud("cdr", only_xyz))

    assert (scan.intensity, scan.ring, scan.offsets_ns) == (None, None, None)
    with pytest.raises(
        DecodeError, match=r"/points: sensor_msgs/msg/PointCloud2 at log time \d+.*no point field z"
    ):
        _decode(cloud("cdr", no_z))


def test_points_that_are_not_finite_leave_all_fields_and_are_counted() -> None:
    points = _points("velodyne")
    points["x"][3], points["z"][5] = np.nan, np.inf
    message = cloud("cdr", points)
    decoder = decoder_for(message.channel)

    scan = decoder(message)

    assert isinstance(scan, LidarScan)
    kept = np.delete(np.arange(_N), [3, 5])
    np.testing.assert_array_equal(scan.points[:, 1], kept + 1)
    assert scan.ring is not None
    np.testing.assert_array_equal(scan.ring, kept % 16)
    assert scan.offsets_ns is not None
    assert len(scan.offsets_ns) == _N - 2
    assert decoder.notices == {"points that are not finite": 2}


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_no_point_and_of_one(count: int) -> None:
    assert len(_decode(cloud("cdr", _points("ouster")[:count])).points) == count


def test_a_cloud_of_nan_alone_is_empty() -> None:
    points = _points("hesai")
    points["y"] = np.nan

    assert len(_decode(cloud("cdr", points)).points) == 0


def test_rows_may_end_in_padding() -> None:
    points = _points("velodyne")
    rows = [row.tobytes() + bytes(10) for row in points.reshape(4, 10)]
    data = np.frombuffer(b"".join(rows), np.uint8)

    scan = _decode(cloud("cdr", points, height=4, width=10, row_step=len(rows[0]), data=data))

    np.testing.assert_array_equal(scan.points[:, 0], np.arange(_N))


def test_an_unknown_time_field_is_reported() -> None:
    points = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("gps_time", "<f4")])
    message = cloud("cdr", points)
    decoder = decoder_for(message.channel)

    scan = decoder(message)

    assert isinstance(scan, LidarScan)
    assert scan.offsets_ns is None
    assert list(decoder.notices) == [
        "scans whose field 'gps_time' may be a time, but of a kind that is not known"
    ]


def test_times_of_another_clock_are_taken_after_the_first_point() -> None:
    points = _points("hesai")
    points["timestamp"] -= 1e6
    message = cloud("cdr", points)
    decoder = decoder_for(message.channel)

    scan = decoder(message)

    assert isinstance(scan, LidarScan)
    assert scan.offsets_ns is not None
    np.testing.assert_allclose(scan.offsets_ns, _OFFSETS_NS, atol=300)
    assert list(decoder.notices) == [
        "scans whose point times ('timestamp') are of another clock than the stamp"
    ]


def test_data_shorter_than_the_points_is_an_error() -> None:
    points = _points("ouster")

    with pytest.raises(DecodeError, match=r"1 x 50 points of \d+ bytes do not fit in"):
        _decode(cloud("cdr", points, width=50))


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_livox_custom_messages(encoding: str) -> None:
    points = [
        make(encoding, "livox_ros_driver2/CustomPoint", offset_time=k * 1000, x=float(k), y=1.0,
             z=2.0, reflectivity=k, tag=0, line=k % 4)
        for k in range(7)
    ]  # fmt: skip
    message = make(
        encoding,
        "livox_ros_driver2/CustomMsg",
        header=header(encoding, "livox"),
        timebase=5,
        point_num=7,
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=points,
    )

    scan = _decode(raw(encoding, "livox_ros_driver2/CustomMsg", message))

    np.testing.assert_array_equal(scan.points[:, 0], np.arange(7))
    assert scan.offsets_ns is not None
    np.testing.assert_array_equal(scan.offsets_ns, np.arange(7) * 1000)
    assert scan.ring is not None
    np.testing.assert_array_equal(scan.ring, [0, 1, 2, 3, 0, 1, 2])
