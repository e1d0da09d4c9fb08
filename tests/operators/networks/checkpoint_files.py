"""Checkpoints as PyTorch writes them, written without it, whatever they name."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Writer = Callable[[object], bytes]
_STORAGES = {"float32": "FloatStorage", "int64": "LongStorage", "uint8": "ByteStorage"}


@dataclass(frozen=True)
class Named:
    """Something by its name, called if there are arguments."""

    module: str
    name: str
    arguments: tuple[object, ...] | None = None


@dataclass(frozen=True, eq=False)
class Tensor:
    """A view of numbers, of sizes that need not fit them."""

    numbers: npt.NDArray[Any]  # (N,)
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class Pickled:
    """The pickle of a value and the storages of its tensors, in their order."""

    def __init__(self, root: object, tail: tuple[object, ...]) -> None:
        self.storages: list[npt.NDArray[Any]] = []
        self._tail = tail
        self.data = pickle.PROTO + b"\x02" + self._written(root) + pickle.STOP

    def _written(self, value: object) -> bytes:
        if isinstance(value, np.ndarray):
            strides = tuple(s // value.itemsize for s in np.ascontiguousarray(value).strides)
            value = Tensor(value.reshape(-1), value.shape, strides)
        if isinstance(value, Tensor):
            return self._tensor(value)
        if isinstance(value, Named):
            called = f"c{value.module}\n{value.name}\n".encode()
            arguments = value.arguments
            return called + (b"" if arguments is None else self._written(arguments) + pickle.REDUCE)
        if isinstance(value, dict):
            items = (self._written(k) + self._written(v) + pickle.SETITEM for k, v in value.items())
            return pickle.EMPTY_DICT + b"".join(items)
        if isinstance(value, tuple):
            return pickle.MARK + b"".join(map(self._written, value)) + pickle.TUPLE
        return pickle.dumps(value, protocol=2)[2:-1]  # numbers, text, None, lists of them

    def _tensor(self, tensor: Tensor) -> bytes:
        kind = Named("torch", _STORAGES[tensor.numbers.dtype.name])
        key = str(len(self.storages))
        self.storages.append(tensor.numbers)
        stored = ("storage", kind, key, "cpu", tensor.numbers.size, *self._tail)
        tail = (0, tensor.shape, tensor.strides, False, Named("collections", "OrderedDict", ()))
        arguments = self._written(stored) + pickle.BINPERSID + b"".join(map(self._written, tail))
        rebuild = self._written(Named("torch._utils", "_rebuild_tensor_v2"))
        return rebuild + pickle.MARK + arguments + pickle.TUPLE + pickle.REDUCE


def as_zip(root: object) -> bytes:
    """Return a checkpoint in the layout of today."""
    pickled = Pickled(root, ())
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("archive/data.pkl", pickled.data)
        for key, numbers in enumerate(pickled.storages):
            archive.writestr(f"archive/data/{key}", numbers.tobytes())
    return out.getvalue()


def as_legacy(root: object) -> bytes:
    """Return a checkpoint in the layout before version 1.6."""
    pickled = Pickled(root, (None,))
    heads = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})
    keys = [str(key) for key in range(len(pickled.storages))]
    parts = [*(pickle.dumps(head, protocol=2) for head in heads), pickled.data, pickle.dumps(keys)]
    for numbers in pickled.storages:
        parts += [numbers.size.to_bytes(8, "little"), numbers.tobytes()]
    return b"".join(parts)
