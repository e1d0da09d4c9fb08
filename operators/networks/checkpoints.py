"""Tensors of a PyTorch checkpoint as arrays, without PyTorch, and without running what the file says.

A checkpoint is a pickle, and a pickle may call any function.
This reader knows tensors, their storages and ordered dictionaries, and refuses whatever else is named.

Both layouts are read: the zip archive (PyTorch 1.6 and later), and the stream of pickles before it.
Source: PyTorch's `torch/serialization.py` and `torch/_utils.py`, for the layout.
"""

from __future__ import annotations

import io
import pickle  # read through a table of what may be named
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.errors import RecordingError

Weights = dict[str, npt.NDArray[Any]]

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_STORAGES = {  # text, since a pickle could change an object
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}


@dataclass(slots=True)
class _Storage:
    """Numbers that tensors are views of; the legacy layout brings them after the tensors."""

    dtype: np.dtype[Any]
    count: int
    values: npt.NDArray[Any] | None = None

    def fill(self, data: bytes) -> None:
        if len(data) != self.count * self.dtype.itemsize:
            raise RecordingError(
                f"a storage of {len(data)} bytes, expected {self.count} x {self.dtype.itemsize}"
            )
        self.values = np.frombuffer(data, self.dtype)


@dataclass(frozen=True, slots=True)
class _Tensor:
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers, not bytes

    def array(self) -> npt.NDArray[Any]:
        """Return a copy of the numbers of this tensor.

        Raises:
            RecordingError: If it reaches beyond its storage.
        """
        values = self.storage.values
        last = self.offset + sum(
            (n - 1) * step for n, step in zip(self.shape, self.strides, strict=True)
        )
        if values is None or min((self.offset, *self.strides, *self.shape)) < 0:
            raise RecordingError("a tensor without numbers, or with negative sizes")
        if 0 in self.shape:
            return np.empty(self.shape, values.dtype)
        if last >= len(values):
            raise RecordingError(f"a tensor of {last + 1} numbers in a storage of {len(values)}")
        step = values.dtype.itemsize
        view = np.lib.stride_tricks.as_strided(
            values[self.offset :], self.shape, [s * step for s in self.strides], writeable=False
        )
        return view.copy()


def _rebuild_tensor(
    storage: _Storage, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: object
) -> _Tensor:
    if not isinstance(storage, _Storage):
        raise RecordingError(f"a tensor of {type(storage).__name__}, expected one of a storage")
    return _Tensor(storage, int(offset), tuple(map(int, shape)), tuple(map(int, strides)))


_KNOWN: dict[tuple[str, str], object] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor"): _rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    **{("torch", name): dtype for name, dtype in _STORAGES.items()},
}


class _Unpickler(pickle.Unpickler):
    """Reads a pickle that names nothing but what is known here."""

    def __init__(self, file: io.BytesIO, load: Callable[[str, int, str], _Storage]) -> None:
        super().__init__(file, encoding="utf-8")
        self._load = load

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401  # what pickle asks for
        found = _KNOWN.get((module, name))
        if found is None:
            raise RecordingError(
                f"the checkpoint names {module}.{name}, which is neither a tensor, a storage nor an "
                "ordered dictionary; it was not run, and the file is refused"
            )
        return found

    def persistent_load(self, pid: Any) -> _Storage:  # noqa: ANN401  # what the file says
        if not (isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage"):
            raise RecordingError(f"a reference to {pid!r}, expected one to a storage")
        kind, key, _, count = pid[1:5]
        if kind not in _STORAGES.values():
            raise RecordingError(f"a storage of {kind!r}, expected one of numbers")
        if len(pid) > 5 and pid[5] is not None:
            raise RecordingError("a storage that is a view of another; save the checkpoint anew")
        return self._load(str(key), int(count), kind)


def read_checkpoint(data: bytes) -> Weights:
    """Return the tensors of a checkpoint by name.

    Args:
        data: The file.

    Raises:
        RecordingError: If it is damaged, of another layout, holds something else than named tensors,
            or names what is neither a tensor, a storage nor an ordered dictionary.
    """
    try:
        read = _read_zip if zipfile.is_zipfile(io.BytesIO(data)) else _read_legacy
        return _arrays(read(data))
    except RecordingError:
        raise
    except (  # what pickle and zipfile raise on damaged files, of which there is no end
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        ArithmeticError,
        AttributeError,
        EOFError,
        LookupError,
        MemoryError,
        NotImplementedError,
        TypeError,
        ValueError,
    ) as error:
        raise RecordingError(
            f"not a checkpoint of PyTorch that can be read: {type(error).__name__}: {error}"
        ) from error


def _read_zip(data: bytes) -> object:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise RecordingError(f"{len(pickles)} members data.pkl in the checkpoint, expected one")
        folder = pickles[0].removesuffix("data.pkl")
        if f"{folder}byteorder" in archive.namelist():
            order = archive.read(f"{folder}byteorder")
            if order != b"little":
                raise RecordingError(f"numbers in {order!r} order, expected little")
        storages: dict[str, _Storage] = {}

        def load(key: str, count: int, dtype: str) -> _Storage:
            if key not in storages:
                storages[key] = _Storage(np.dtype(dtype), count)
                storages[key].fill(archive.read(f"{folder}data/{key}"))
            return storages[key]

        return _Unpickler(io.BytesIO(archive.read(pickles[0])), load).load()


def _read_legacy(data: bytes) -> object:
    file = io.BytesIO(data)
    storages: dict[str, _Storage] = {}

    def load(key: str, count: int, dtype: str) -> _Storage:
        return storages.setdefault(key, _Storage(np.dtype(dtype), count))

    def next_pickle() -> object:
        return _Unpickler(file, load).load()

    start = (next_pickle(), next_pickle())
    if start != (_LEGACY_MAGIC, _LEGACY_PROTOCOL):
        raise RecordingError(f"neither a zip archive nor a legacy checkpoint: it begins {start}")
    next_pickle()  # about the system that wrote it
    root, keys = next_pickle(), next_pickle()
    if not isinstance(keys, list) or set(keys) != set(storages):
        raise RecordingError("the storages are not those that the tensors name")
    for key in keys:
        storage = storages[key]
        count = int.from_bytes(file.read(8), "little")
        if count != storage.count:
            raise RecordingError(f"a storage of {count} numbers, expected {storage.count}")
        storage.fill(file.read(count * storage.dtype.itemsize))
    return root


def _arrays(root: object) -> Weights:
    """Return the tensors of a dictionary by name, those of dictionaries inside with a dot between."""
    if not isinstance(root, dict):
        raise RecordingError(f"the checkpoint is a {type(root).__name__}, expected named tensors")
    found: Weights = {}
    for name, value in root.items():
        if isinstance(value, _Tensor):
            found[str(name)] = value.array()
        elif isinstance(value, dict):
            found.update({f"{name}.{inner}": array for inner, array in _arrays(value).items()})
        elif not isinstance(value, (int, float, str, bool, type(None))):
            raise RecordingError(f"{name} is a {type(value).__name__}, expected a tensor")
    return found
