"""Point clouds of any field layout as `LidarScan`.

Vendors differ in what they call intensity and beam, and most of all in the time of each point:
Ouster `t` uint32 [ns], Velodyne `time` float32 [s], Livox `offset_time` uint32 [ns] after the stamp;
Hesai and Robosense `timestamp` float64 [s], Livox `timestamp` float64 [ns] since 1970.
The type and the size of the numbers tell which.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.messages.sensors import LidarScan, OrganizedCloud

INTENSITY: Final = ("intensity", "intensities", "reflectivity", "i", "signal")
RING: Final = ("ring", "line", "channel", "laser_id", "laserid", "row")
TIMES: Final = (
    "t", "time", "timestamp", "offset_time", "time_stamp", "time_offset", "timeoffset", "offset_ns",
    "t_offset", "point_time_offset",
)  # fmt: skip
COLORS: Final = ("rgb", "rgba")
_ABSOLUTE_S, _ABSOLUTE_NS = 5e8, 1e16  # least seconds and nanoseconds since 1970 that are dates
_MAX_SWEEP_S: Final = 10.0  # a relative time above it is not in seconds
_MAX_FROM_STAMP_NS: Final = 2 * 10**9  # absolute times farther off are of another clock


@dataclass(frozen=True, slots=True)
class PointField:
    """One number of each point."""

    name: str
    dtype: str  # of numpy
    offset: int  # in the point [bytes]


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """Where the parts of a scan lie in a point."""

    dtype: np.dtype[np.void]
    xyz_offset: int | None  # where three float32 follow each other; None elsewhere
    intensity: str | None
    ring: str | None
    time: str | None
    unknown_times: tuple[str, ...]  # fields that sound like a time


@lru_cache(maxsize=256)
def layout_of(fields: tuple[PointField, ...], point_bytes: int) -> CloudLayout:
    """Find the parts of a scan among the fields.

    Raises:
        ValueError: If there is no x, y or z, or a field lies outside of the point.
    """
    by_name = {field.name.lower(): field for field in fields}
    missing = [name for name in "xyz" if name not in by_name]
    if missing:
        there = ", ".join(field.name for field in fields) or "none"
        raise ValueError(f"no point field {', '.join(missing)}; there are: {there}")
    for field in fields:
        if field.offset + np.dtype(field.dtype).itemsize > point_bytes:
            raise ValueError(f"point field {field.name} lies outside of the {point_bytes} bytes")
    dtype = np.dtype(
        {
            "names": list(by_name),
            "formats": [field.dtype for field in by_name.values()],
            "offsets": [field.offset for field in by_name.values()],
            "itemsize": point_bytes,
        }
    )
    start = by_name["x"].offset
    packed = [(by_name[name].dtype, by_name[name].offset) for name in "xyz"]
    is_packed = packed == [("<f4", start), ("<f4", start + 4), ("<f4", start + 8)]
    time = next((name for name in TIMES if name in by_name), None)
    return CloudLayout(
        dtype=dtype,
        xyz_offset=start if is_packed else None,
        intensity=next((name for name in INTENSITY if name in by_name), None),
        ring=next((name for name in RING if name in by_name), None),
        time=time,
        unknown_times=tuple(
            n for n in by_name if time is None and ("time" in n or n in ("ts", "stamp"))
        ),
    )


@dataclass(frozen=True, slots=True)
class CloudSize:
    """How many points there are; a row may end in padding."""

    rows: int
    columns: int
    row_bytes: int


def points_view(data: memoryview, layout: CloudLayout, size: CloudSize) -> npt.NDArray[np.void]:
    """Return all points as one structured array that views the message.

    Raises:
        ValueError: If the data is shorter than the points.
    """
    point_bytes = layout.dtype.itemsize
    row_bytes = max(size.row_bytes, size.columns * point_bytes)  # some drivers leave it at zero
    if len(data) < (size.rows - 1) * row_bytes + size.columns * point_bytes:
        raise ValueError(
            f"{size.rows} x {size.columns} points of {point_bytes} bytes do not fit in {len(data)}"
        )
    if size.rows == 1 or row_bytes == size.columns * point_bytes:
        return np.ndarray((size.rows * size.columns,), layout.dtype, data)
    shape, strides = (size.rows, size.columns), (row_bytes, point_bytes)
    return np.ndarray(shape, layout.dtype, data, strides=strides).ravel()


def scan_of(
    points: npt.NDArray[np.void],
    layout: CloudLayout,
    *,
    stamp_ns: int,
    frame: str,
    notices: Counter[str],
) -> LidarScan:
    """Make a scan of finite points; what is left out or not understood is counted in `notices`."""
    xyz = _xyz(points, layout)
    flat = xyz.ravel()
    if not np.isfinite(np.dot(flat, flat)):  # one pass, no temporary; an overflow only costs a look
        is_finite = np.isfinite(xyz).all(axis=1)
        notices["points that are not finite"] += int((~is_finite).sum())
        xyz, points = xyz[is_finite], points[is_finite]
    for name in layout.unknown_times:
        notices[f"scans whose field {name!r} may be a time, but of a kind that is not known"] += 1
    return LidarScan(
        stamp_ns=stamp_ns,
        points=xyz,
        intensity=None if layout.intensity is None else points[layout.intensity].astype(np.float32),
        ring=None if layout.ring is None else points[layout.ring].astype(np.uint16),
        offsets_ns=_offsets(points, layout, stamp_ns, notices),
        frame=frame or "lidar",
    )


def organized_cloud_of(
    points: npt.NDArray[np.void],
    layout: CloudLayout,
    size: CloudSize,
    *,
    stamp_ns: int,
    frame: str,
) -> OrganizedCloud:
    """Make an organised cloud; a point with a coordinate that is not finite, or at the camera, is no point."""
    xyz = _xyz(points, layout)
    xyz[~(np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1))] = np.nan
    shape = (size.rows, size.columns, 3)
    colors_rgb = _colors_rgb(points)
    return OrganizedCloud(
        stamp_ns=stamp_ns,
        points=xyz.reshape(shape),
        colors_rgb=None if colors_rgb is None else colors_rgb.reshape(shape),
        frame=frame or "camera",
    )


def _colors_rgb(points: npt.NDArray[np.void]) -> npt.NDArray[np.uint8] | None:
    """Return the colours (N, 3); PCL packs blue, green and red into the first bytes of a number of any type."""
    name = next((name for name in COLORS if name in (points.dtype.names or ())), None)
    if name is None or points.dtype[name].itemsize != 4:
        return None
    packed = points[name].copy().view(np.uint8).reshape(-1, 4)
    return np.ascontiguousarray(packed[:, 2::-1])


def _xyz(points: npt.NDArray[np.void], layout: CloudLayout) -> Float32Array:
    if layout.xyz_offset is None:
        return np.stack([points[name].astype(np.float32) for name in "xyz"], axis=1)
    # copying 12 bytes at once is twice as fast as three numbers, and lets go of the chunk
    packed = np.dtype({"names": ["xyz"], "formats": ["V12"], "offsets": [layout.xyz_offset],
                       "itemsize": layout.dtype.itemsize})  # fmt: skip
    return points.view(packed)["xyz"].copy().view("<f4").reshape(-1, 3)


def _offsets(
    points: npt.NDArray[np.void], layout: CloudLayout, stamp_ns: int, notices: Counter[str]
) -> IntArray | None:
    if layout.time is None or not len(points):
        return None
    times = points[layout.time]
    if times.dtype.kind == "f" and not np.isfinite(times).all():
        notices[f"scans whose point times ({layout.time!r}) are not all finite"] += 1
        return None
    offsets = _relative_ns(times, stamp_ns)
    if offsets is None:
        notices[f"scans whose point times ({layout.time!r}) are in no known unit"] += 1
    elif max(abs(int(offsets.min())), abs(int(offsets.max()))) > _MAX_FROM_STAMP_NS:
        notices[
            f"scans whose point times ({layout.time!r}) are of another clock than the stamp"
        ] += 1
        offsets = offsets - offsets.min()
    return offsets


def _relative_ns(times: npt.NDArray[Any], stamp_ns: int) -> IntArray | None:
    """Return times after the stamp; None where the size of the numbers fits no unit."""
    largest = float(np.abs(times).max()) if times.dtype.kind != "u" else float(times.max())
    if largest >= _ABSOLUTE_NS:
        offsets = times.astype(np.int64) - np.int64(stamp_ns)
    elif times.dtype.itemsize == 8 and _ABSOLUTE_S <= largest < _ABSOLUTE_S * 100:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        offsets = np.rint((times - seconds) * 1e9).astype(np.int64) - np.int64(nanoseconds)
    elif times.dtype.kind != "f" or 1e5 <= largest < _ABSOLUTE_S:
        offsets = np.rint(times).astype(np.int64)  # nanoseconds, even in floats
    elif largest <= _MAX_SWEEP_S:
        offsets = np.rint(times.astype(np.float64) * 1e9).astype(np.int64)
    else:
        return None
    return np.asarray(offsets, np.int64)
