"""Keyframe clouds on disk, the ones in use in memory too, up to a bound.

A cloud is an Arrow IPC file: `points`, `intensity` where the sensor has it, and `colors_rgba` where cameras saw it;
its stamp is in the schema.
A cloud read back equals the one put, bit for bit, so it does not matter which of the two a caller gets.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.errors import MapError, MapFormatError
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.sizes import nbytes

_KEY = re.compile(r"[0-9A-Za-z_][0-9A-Za-z_.-]{0,127}")
_SUFFIX = ".arrow"


def cloud_key(mission_id: str, stamp_ns: int) -> str:
    """Return the key of a keyframe's cloud."""
    return f"{mission_id}_{stamp_ns}"


class CloudStore:
    """Clouds by key in a folder; keys are file names: letters, digits, and `_ . -` inside.

    Not for several threads at a time.
    """

    def __init__(self, directory: Path | None = None, max_bytes: int = 256_000_000) -> None:
        """Open a store.

        Args:
            directory: Where the clouds lie, and stay after the run; by default a temporary folder.
            max_bytes: What the clouds that are kept in memory may take.
        """
        self._temporary: TemporaryDirectory[str] | None = None
        if directory is None:
            self._temporary = TemporaryDirectory(prefix="mapstream-")
            directory = Path(self._temporary.name)
        self.directory = directory
        self.directory.mkdir(parents=True, exist_ok=True)
        self.max_bytes = max_bytes
        self.num_bytes = 0  # of the clouds in memory
        self._recent: OrderedDict[str, PointCloud] = OrderedDict()  # least recently used first

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def path_of(self, key: str) -> Path:
        """Return the file of a cloud.

        Raises:
            ValueError: If the key cannot be the name of a file.
        """
        if not _KEY.fullmatch(key):
            raise ValueError(f"the key of a cloud is letters, digits and _ . -, got {key!r}")
        return self.directory / f"{key}{_SUFFIX}"

    def put(self, key: str, cloud: PointCloud) -> None:
        """Keep a cloud; it takes the place of one with this key.

        Raises:
            MapError: If it cannot be written, as on a full disk.
        """
        write_cloud(self.path_of(key), cloud, is_durable=self._temporary is None)
        self._remember(key, cloud)

    def get(self, key: str) -> PointCloud:
        """Return a cloud.

        Raises:
            MapError: If there is none with this key, or its file is damaged.
        """
        cloud = self._recent.get(key)
        if cloud is None:
            cloud = read_cloud(self.path_of(key))
        self._remember(key, cloud)
        return cloud

    def _remember(self, key: str, cloud: PointCloud) -> None:
        old = self._recent.pop(key, None)
        self.num_bytes += nbytes(cloud) - (nbytes(old) if old is not None else 0)
        self._recent[key] = cloud
        while self.num_bytes > self.max_bytes:
            _, dropped = self._recent.popitem(last=False)
            self.num_bytes -= nbytes(dropped)

    def __contains__(self, key: str) -> bool:
        return key in self._recent or self.path_of(key).exists()

    def keys(self) -> list[str]:
        """Return the keys of all clouds, sorted."""
        return sorted(path.stem for path in self.directory.glob(f"*{_SUFFIX}"))

    def close(self) -> None:
        """Forget the clouds in memory, and remove a temporary folder."""
        self._recent.clear()
        self.num_bytes = 0
        if self._temporary:
            self._temporary.cleanup()


def write_cloud(path: Path, cloud: PointCloud, *, is_durable: bool = True) -> None:
    """Write a cloud's file, whole or not at all.

    Raises:
        MapError: If the disk refuses.
    """
    columns = {"points": _rows(cloud.points)}
    if cloud.intensity is not None:
        columns["intensity"] = pa.array(np.ascontiguousarray(cloud.intensity))
    if cloud.colors_rgba is not None:
        columns["colors_rgba"] = _rows(cloud.colors_rgba)
    batch = pa.record_batch(columns).replace_schema_metadata({"stamp_ns": str(cloud.stamp_ns)})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, batch.schema) as writer:
        writer.write_batch(batch)
    try:
        write_whole(path, memoryview(sink.getvalue()), is_durable=is_durable)
    except OSError as error:
        raise MapError(
            f"{path}: the cloud could not be written: {error}; free some space"
        ) from error


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud's file.

    Raises:
        MapError: If it is not there, or is damaged.
    """
    try:
        data = path.read_bytes()
        table = pa.ipc.open_file(data).read_all()
        table.validate(full=True)
        stamp_ns = int(table.schema.metadata[b"stamp_ns"])
        columns = {name: table[name].combine_chunks() for name in table.column_names}
        intensity, colors = columns.get("intensity"), columns.get("colors_rgba")
        return PointCloud(
            stamp_ns=stamp_ns,
            points=columns["points"].flatten().to_numpy().reshape(-1, 3),
            intensity=None if intensity is None else intensity.to_numpy(),
            colors_rgba=None if colors is None else colors.flatten().to_numpy().reshape(-1, 4),
        )
    except FileNotFoundError as error:
        raise MapError(f"{path}: no such cloud; was the map copied without its clouds?") from error
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise MapFormatError(f"{path}: damaged: {error}; restore it from a copy") from error


def _rows(array: npt.NDArray[Any]) -> pa.FixedSizeListArray:
    values = pa.array(np.ascontiguousarray(array).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(values, array.shape[1])
