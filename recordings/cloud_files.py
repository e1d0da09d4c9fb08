"""Point clouds as PLY and PCD files.

Written: little-endian binary with `x y z`, and `intensity` and colours where given.
Read: binary and ASCII of any program; fields of other names are skipped.
Why no library does this: docs/decisions/0005-cloud-files.md.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.arrays import Float32Array, frozen, frozen_optional
from mapstream.streams.errors import RecordingError

_MAX_HEADER_BYTES = 65_536
_KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_OLD_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_NEW_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_PLY_TYPES = dict(zip(_OLD_NAMES + _NEW_NAMES, _KINDS * 2, strict=True))
_PLY_NAMES = {"f4": "float", "u1": "uchar"}
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLORS = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileCloud:
    """What a cloud file holds."""

    points: Float32Array  # (N, 3) [m]; not finite where an organised cloud saw nothing
    intensity: Float32Array | None = None  # (N,)
    colors_rgb: npt.NDArray[np.uint8] | None = None  # (N, 3)

    def __post_init__(self) -> None:
        n = frozen(self, "points", np.float32, (None, 3)).shape[0]
        frozen_optional(self, "intensity", np.float32, (n,))
        frozen_optional(self, "colors_rgb", np.uint8, (n, 3))


def write_ply(
    path: str | Path,
    points: npt.ArrayLike,
    intensity: npt.ArrayLike | None = None,
    colors_rgb: npt.ArrayLike | None = None,
) -> None:
    """Write points (N, 3) [m], intensity (N,) and colours (N, 3) as PLY, whole or not at all.

    Raises:
        ValueError: If the shapes do not fit.
        RecordingError: If the disk refuses.
    """
    cloud = _checked(points, intensity, colors_rgb)
    fields = [(name, "<f4") for name in _float_fields(cloud)]
    if cloud.colors_rgb is not None:
        fields += [(name, "u1") for name in _COLORS]
    rows = _rows(cloud, fields)
    if cloud.colors_rgb is not None:
        for name, column in zip(_COLORS, cloud.colors_rgb.T, strict=True):
            rows[name] = column
    properties = [f"property {_PLY_NAMES[kind[-2:]]} {name}" for name, kind in fields]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties]
    _write(Path(path), [*header, "end_header"], rows)


def write_pcd(
    path: str | Path,
    points: npt.ArrayLike,
    intensity: npt.ArrayLike | None = None,
    colors_rgb: npt.ArrayLike | None = None,
) -> None:
    """Write points (N, 3) [m], intensity (N,) and colours (N, 3) as PCD 0.7, whole or not at all.

    Raises:
        ValueError: If the shapes do not fit.
        RecordingError: If the disk refuses.
    """
    cloud = _checked(points, intensity, colors_rgb)
    fields = [(name, "<f4") for name in _float_fields(cloud)]
    if cloud.colors_rgb is not None:
        fields.append(("rgb", "<u4"))
    rows = _rows(cloud, fields)
    if cloud.colors_rgb is not None:
        rows["rgb"] = cloud.colors_rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in fields)}",
        f"SIZE {' '.join('4' for _ in fields)}",
        f"TYPE {' '.join('U' if name == 'rgb' else 'F' for name, _ in fields)}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary",
    ]
    _write(Path(path), header, rows)


def read_ply(path: str | Path) -> FileCloud:
    """Read the vertices of a PLY file.

    Raises:
        RecordingError: If it is absent, damaged, or has no points.
    """
    file = _File(Path(path), b"end_header")
    if not file.header or file.header[0] != "ply":
        raise file.error("expected 'ply' in the first line")
    order, count, fields, element = "", -1, [], ""
    for words in (line.split() for line in file.header[1:]):
        match words:
            case ["format", name, _] if name in _PLY_ORDERS:
                order = name
            case ["element", element, number]:
                if count < 0 and element != "vertex":
                    raise file.error(f"expected the vertices first, found {element}")
                count = file.count(number) if element == "vertex" else count
            case ["property", kind, name] if element == "vertex" and kind in _PLY_TYPES:
                fields.append((name, _PLY_ORDERS.get(order, "") + _PLY_TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise file.error(f"cannot read the property {' '.join(words[1:])!r}")
    if not order or count < 0:
        raise file.error("expected a format and vertices in the header")
    return file.cloud(fields, count, is_ascii=order == "ascii")


def read_pcd(path: str | Path) -> FileCloud:
    """Read a PCD file.

    Raises:
        RecordingError: If it is absent, damaged, compressed, or has no points.
    """
    file = _File(Path(path), b"\nDATA")
    entries = {words[0]: words[1:] for line in file.header if (words := line.split())}
    try:
        kinds = [
            (name, f"<{'iuf'['IUF'.index(kind)]}{int(size)}", (int(count),))
            for name, size, kind, count in zip(
                *(entries[key] for key in ("FIELDS", "SIZE", "TYPE")),
                entries.get("COUNT", ["1"] * len(entries["FIELDS"])),
                strict=True,
            )
        ]
        fields = [
            (f"{name}.{index}" if shape[0] > 1 else name, kind)
            for name, kind, shape in kinds
            for index in range(shape[0])
        ]
        count, (data,) = file.count(entries["POINTS"][0]), entries["DATA"]
    except (KeyError, ValueError, IndexError) as error:
        raise file.error(f"the header is incomplete: {error}") from error
    if data not in ("ascii", "binary"):
        raise file.error(f"expected DATA ascii or binary, found {data}; save it as binary")
    return file.cloud(fields, count, is_ascii=data == "ascii")


class _File:
    """A file whose text header ends with the line that holds `last`."""

    def __init__(self, path: Path, last: bytes) -> None:
        self.path = path
        try:
            self._content = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read as a cloud: {error}") from error
        end = self._content.find(last, 0, _MAX_HEADER_BYTES)
        end = self._content.find(b"\n", end + len(last)) if end >= 0 else -1
        if end < 0:
            raise self.error(f"the header does not end: there is no line {last.decode().strip()!r}")
        text = self._content[:end].decode(errors="replace")
        lines = (line.strip() for line in text.splitlines())
        self.header = [line for line in lines if line and not line.startswith("#")]
        self._start = end + 1

    def error(self, reason: str) -> RecordingError:
        return RecordingError(f"{self.path}: {reason}")

    def count(self, word: str) -> int:
        if not word.isdigit():
            raise self.error(f"expected a number of points, found {word!r}")
        return int(word)

    def cloud(self, fields: list[tuple[str, str]], count: int, *, is_ascii: bool) -> FileCloud:
        """Take `count` rows of the fields from what follows the header."""
        columns = self._text(fields, count) if is_ascii else self._binary(fields, count)
        missing = [name for name in "xyz" if name not in columns]
        if missing:
            found = ", ".join(name for name, _ in fields)
            raise self.error(f"expected fields x, y, z, found {found}")
        colors = None
        if all(name in columns for name in _COLORS):
            colors = np.stack([columns[name] for name in _COLORS], axis=1).astype(np.uint8)
        elif "rgb" in columns:  # packed into the bits of an integer or of a float
            packed = np.ascontiguousarray(columns["rgb"])
            bits = packed.view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
            colors = (bits[:, None] >> np.array([16, 8, 0], np.uint32)).astype(np.uint8)
        return FileCloud(
            points=np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32),
            intensity=columns.get("intensity"),
            colors_rgb=colors,
        )

    def _binary(self, fields: list[tuple[str, str]], count: int) -> dict[str, npt.NDArray[Any]]:
        try:
            kind = np.dtype(fields)
        except (TypeError, ValueError) as error:
            raise self.error(f"cannot read the fields {fields}: {error}") from error
        have = len(self._content) - self._start
        if have < count * kind.itemsize:
            expected = f"{count} points of {kind.itemsize} bytes"
            raise self.error(f"truncated: expected {expected}, found {have} bytes")
        rows = np.frombuffer(self._content, kind, count, self._start)
        return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name, _ in fields}

    def _text(self, fields: list[tuple[str, str]], count: int) -> dict[str, npt.NDArray[Any]]:
        lines = io.StringIO(self._content[self._start :].decode(errors="replace"))
        try:
            rows = (
                np.loadtxt(lines, ndmin=2, max_rows=count) if count else np.empty((0, len(fields)))
            )
        except ValueError as error:
            raise self.error(f"cannot read the points: {error}") from error
        if rows.shape != (count, len(fields)):
            raise self.error(f"expected {(count, len(fields))} numbers, found {rows.shape}")
        return {
            name: column.astype(np.dtype(kind).newbyteorder("="))
            for (name, kind), column in zip(fields, rows.T, strict=True)
        }


def _checked(
    points: npt.ArrayLike, intensity: npt.ArrayLike | None, colors_rgb: npt.ArrayLike | None
) -> FileCloud:
    return FileCloud(
        points=np.asarray(points, dtype=np.float32),
        intensity=None if intensity is None else np.asarray(intensity, dtype=np.float32),
        colors_rgb=None if colors_rgb is None else np.asarray(colors_rgb, dtype=np.uint8),
    )


def _float_fields(cloud: FileCloud) -> list[str]:
    return ["x", "y", "z", *(["intensity"] if cloud.intensity is not None else [])]


def _rows(cloud: FileCloud, fields: list[tuple[str, str]]) -> npt.NDArray[Any]:
    rows = np.empty(len(cloud.points), dtype=fields)
    for name, column in zip("xyz", cloud.points.T, strict=True):
        rows[name] = column
    if cloud.intensity is not None:
        rows["intensity"] = cloud.intensity
    return rows


def _write(path: Path, header: Iterable[str], rows: npt.NDArray[Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, "".join(f"{line}\n" for line in header).encode() + rows.tobytes())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
