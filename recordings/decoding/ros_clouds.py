"""ROS point clouds as `LidarScan`: sensor_msgs/PointCloud2 and the CustomMsg of Livox drivers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.recordings.decoding.cursor import CdrCursor
from mapstream.recordings.decoding.point_fields import (
    CloudLayout,
    CloudSize,
    PointField,
    layout_of,
    organized_cloud_of,
    points_view,
    scan_of,
)
from mapstream.streams.messages.sensors import LidarScan, OrganizedCloud

_DTYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
_LIVOX = layout_of(
    (
        PointField("offset_time", "<u4", 0),
        PointField("x", "<f4", 4),
        PointField("y", "<f4", 8),
        PointField("z", "<f4", 12),
        PointField("reflectivity", "u1", 16),
        PointField("tag", "u1", 17),
        PointField("line", "u1", 18),
    ),
    19,
)


@dataclass(frozen=True, slots=True)
class CloudView:
    """A sensor_msgs/PointCloud2."""

    points: npt.NDArray[np.void]  # (N,) of the layout, row by row
    layout: CloudLayout
    size: CloudSize
    stamp_ns: int
    frame: str


class PointCloudReader:
    """Reads the sensor_msgs/PointCloud2 of one topic; a field table that repeats is parsed once."""

    def __init__(self, notices: Counter[str]) -> None:
        self._notices = notices
        self._layout: CloudLayout | None = None
        self._table_start, self._table = (
            0,
            b"",
        )  # where the layout was in its message, and its bytes

    def __call__(self, cursor: CdrCursor) -> LidarScan:
        seen = self.view(cursor)
        return scan_of(
            seen.points,
            seen.layout,
            stamp_ns=seen.stamp_ns,
            frame=seen.frame,
            notices=self._notices,
        )

    def view(self, cursor: CdrCursor) -> CloudView:
        """Return what a message holds, without a copy."""
        stamp_ns, frame = cursor.header()
        height, width = cursor.u32(), cursor.u32()
        layout = self._read_layout(cursor)
        row_bytes = cursor.u32()
        data = cursor.raw(cursor.u32())
        cursor.u8()  # is_dense: drivers that set it still send points that are not finite
        cursor.end()
        size = CloudSize(height, width, row_bytes)
        return CloudView(points_view(data, layout, size), layout, size, stamp_ns, frame)

    def _read_layout(self, cursor: CdrCursor) -> CloudLayout:
        """Read from the number of fields to the size of a point."""
        start, end = cursor.position, cursor.position + len(self._table)
        is_known = start == self._table_start and cursor.data[start:end] == self._table
        if self._layout is not None and is_known:
            cursor.position = end
            return self._layout
        fields = [_field(cursor) for _ in range(cursor.u32())]
        is_big_endian, point_bytes = cursor.u8(), cursor.u32()
        if is_big_endian:
            raise ValueError("big-endian points")
        self._layout = layout_of(tuple(field for field in fields if field), point_bytes)
        self._table_start, self._table = start, bytes(cursor.data[start : cursor.position])
        return self._layout


class OrganizedCloudReader(PointCloudReader):
    """Reads those that have the rows and columns of an image, as drivers of depth cameras publish them."""

    def __call__(self, cursor: CdrCursor) -> OrganizedCloud:  # type: ignore[override]  # the same bytes, seen as an image
        """Read one.

        Raises:
            ValueError: If all points are in one row.
        """
        seen = self.view(cursor)
        if seen.size.rows < 2:
            raise ValueError(
                f"{seen.size.columns} points in {seen.size.rows} row: no organised cloud, read it as LidarScan"
            )
        return organized_cloud_of(
            seen.points, seen.layout, seen.size, stamp_ns=seen.stamp_ns, frame=seen.frame
        )


def _field(cursor: CdrCursor) -> PointField | None:
    name, offset, kind, count = cursor.text(), cursor.u32(), cursor.u8(), cursor.u32()
    if kind not in _DTYPES:
        raise ValueError(f"point field {name} has the unknown type {kind}")
    return PointField(name, _DTYPES[kind], offset) if count else None  # padding has none


def livox(cursor: CdrCursor, notices: Counter[str]) -> LidarScan:
    """Read a livox_ros_driver(2)/CustomMsg."""
    stamp_ns, frame = cursor.header()
    cursor.array("<u8", 1)  # the same time by the sensor's own clock
    cursor.array("<u4", 1)  # number of points, which the sequence repeats
    cursor.array("<u1", 4)  # LiDAR id, reserved
    count = cursor.u32()
    points = _livox_points(cursor, count)
    cursor.end()
    return scan_of(points, _LIVOX, stamp_ns=stamp_ns, frame=frame, notices=notices)


def _livox_points(cursor: CdrCursor, count: int) -> npt.NDArray[np.void]:
    """Points are 19 bytes; CDR aligns each to 4, and the last has no padding behind it."""
    stride = cursor.stride(_LIVOX.dtype.itemsize, 4)
    if count == 0:
        return np.empty(0, _LIVOX.dtype)
    data = cursor.raw((count - 1) * stride + _LIVOX.dtype.itemsize)
    return np.ndarray((count,), _LIVOX.dtype, data, strides=(stride,))
