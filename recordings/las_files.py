"""Clouds as LAS 1.4 and LAZ: the one door to laspy.

Coordinates are whole millimetres from an offset, so a cloud keeps its precision hundreds of kilometres from
the zero of a projection, where float32 has steps of half a metre.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.errors import RecordingError

_STEP_M = 0.001
_REACH_M = 2**31 * _STEP_M  # from the offset
_PLAIN, _COLORED = 6, 7  # point formats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LasCloud:
    """What a LAS file holds."""

    points: FloatArray  # (N, 3) [m], in the file's projection
    intensity: Float32Array  # (N,) 0 to 65535
    colors_rgb: npt.NDArray[np.uint8] | None  # (N, 3)
    crs: str  # its projection as WKT; empty: it says none


def write_las(
    path: Path,
    points: FloatArray,
    intensity: npt.NDArray[np.floating] | None = None,
    colors_rgb: npt.NDArray[np.uint8] | None = None,
    crs_wkt: str = "",
) -> None:
    """Write points (N, 3) [m] as LAS, or as LAZ by the suffix; whole or not at all.

    Args:
        path: The file.
        points: In the projection, float64.
        intensity: (N,) of any scale; the file's runs from 0 to the largest number it has.
        colors_rgb: (N, 3).
        crs_wkt: The projection as WKT; empty: none.

    Raises:
        RecordingError: If a point is too far from the first one, or the disk refuses.
    """
    import laspy  # noqa: PLC0415  # only where such files are written
    from laspy.vlrs.known import WktCoordinateSystemVlr  # noqa: PLC0415

    header = laspy.LasHeader(version="1.4", point_format=_PLAIN if colors_rgb is None else _COLORED)
    header.scales = np.full(3, _STEP_M)
    header.offsets = np.floor(points[0]) if len(points) else np.zeros(3)
    if np.abs(points - header.offsets).max(initial=0.0) >= _REACH_M:
        raise RecordingError(f"{path}: points more than {_REACH_M:.0f} m apart do not fit into LAS")
    if crs_wkt:
        header.vlrs.append(WktCoordinateSystemVlr(crs_wkt))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if intensity is not None and len(points):
        known = np.nan_to_num(np.asarray(intensity, np.float64)).clip(0.0)
        las.intensity = np.round(known * (65535 / max(known.max(), 1e-12))).astype(np.uint16)
    if colors_rgb is not None:
        las.red, las.green, las.blue = colors_rgb.T.astype(np.uint16) * 257
    content = io.BytesIO()
    las.write(content, do_compress=path.suffix.lower() == ".laz")
    try:
        write_whole(path, content.getbuffer())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error


def read_las(path: Path) -> LasCloud:
    """Read a LAS or LAZ file.

    Raises:
        RecordingError: If it is absent or damaged.
    """
    import laspy  # noqa: PLC0415

    try:
        las = laspy.read(str(path))
        wkt = [v.string for v in las.vlrs if v.record_id == 2112]  # OGC coordinate system WKT
        has_color = "red" in las.point_format.dimension_names
        colors = np.column_stack([las.red, las.green, las.blue]) // 257 if has_color else None
        return LasCloud(
            points=np.asarray(las.xyz, dtype=np.float64),
            intensity=np.asarray(las.intensity, dtype=np.float32),
            colors_rgb=None if colors is None else colors.astype(np.uint8),
            crs=wkt[0] if wkt else "",
        )
    except (OSError, ValueError, laspy.LaspyException) as error:
        raise RecordingError(f"{path}: cannot be read as LAS: {error}") from error
