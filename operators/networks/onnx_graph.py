"""Networks written down as ONNX graphs: a few lines per layer, and the file that onnxruntime reads.

The file is a protocol buffer of few fields, so it is written here, without the `onnx` package.
Source: ONNX, `onnx/onnx.proto`, for the numbers of the fields; operator set 17.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Value = str
"""The name of a tensor in a graph."""
Shape = Sequence[int | str]
"""Sizes, or the names of those that are known at run time only."""
Attribute = int | float | str | Sequence[int]

_OPERATOR_SET = 17
_IR_VERSION = 8
_PRODUCER = b"mapstream"
_ELEMENT_TYPES = {"float32": 1, "uint8": 2, "int32": 6, "int64": 7, "bool": 9, "float16": 10}
_VARINT, _BYTES, _FLOAT = 0, 2, 5  # wire types of protocol buffers


class Graph:
    """A network under construction: `add` appends an operator and returns what it gives.

    Arrays may stand wherever a value is expected; they become the graph's weights.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[bytes] = []
        self._weights: list[bytes] = []
        self._inputs: list[bytes] = []
        self._outputs: list[bytes] = []
        self._metadata: dict[str, str] = {}
        self._count = 0

    def describe(self, key: str, text: str) -> None:
        """Add a line of what the file says of itself."""
        self._metadata[key] = text

    def input(self, name: str, dtype: npt.DTypeLike, shape: Shape) -> Value:
        """Declare an input."""
        self._inputs.append(_value_info(name, dtype, shape))
        return name

    def output(self, name: str, value: Value, dtype: npt.DTypeLike, shape: Shape) -> None:
        """Declare that a value is an output of this name."""
        self._nodes.append(_node("Identity", [value], [name], {}))
        self._outputs.append(_value_info(name, dtype, shape))

    def add(
        self, operator: str, *inputs: Value | npt.NDArray[Any], **attributes: Attribute
    ) -> Value:
        """Append an operator of ONNX and return its first output."""
        return self.add_many(operator, 1, *inputs, **attributes)[0]

    def add_many(
        self, operator: str, count: int, *inputs: Value | npt.NDArray[Any], **attributes: Attribute
    ) -> list[Value]:
        """Append an operator of ONNX and return its first outputs."""
        names = [self._named(i) for i in inputs]
        outputs = [self._new_name() for _ in range(count)]
        self._nodes.append(_node(operator, names, outputs, attributes))
        return outputs

    def serialize(self) -> bytes:
        """Return the model as the bytes of an ONNX file."""
        graph = b"".join(
            [
                *(_field(1, node) for node in self._nodes),
                _field(2, self._name.encode()),
                *(_field(5, weight) for weight in self._weights),
                *(_field(11, info) for info in self._inputs),
                *(_field(12, info) for info in self._outputs),
            ]
        )
        return b"".join(
            [
                _number(1, _IR_VERSION),
                _field(2, _PRODUCER),
                _field(7, graph),
                _field(8, _number(2, _OPERATOR_SET)),
                *(
                    _field(14, _field(1, key.encode()) + _field(2, text.encode()))
                    for key, text in self._metadata.items()
                ),
            ]
        )

    def _named(self, value: Value | npt.NDArray[Any]) -> Value:
        if isinstance(value, str):
            return value
        name = self._new_name()
        self._weights.append(_tensor(name, value))
        return name

    def _new_name(self) -> Value:
        self._count += 1
        return f"v{self._count}"


def _node(
    operator: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    attributes: Mapping[str, Attribute],
) -> bytes:
    return b"".join(
        [
            *(_field(1, name.encode()) for name in inputs),
            *(_field(2, name.encode()) for name in outputs),
            _field(4, operator.encode()),
            *(_field(5, _attribute(name, value)) for name, value in attributes.items()),
        ]
    )


def _attribute(name: str, value: Attribute) -> bytes:
    if isinstance(value, int):
        kind, written = 2, _number(3, value)
    elif isinstance(value, float):
        kind, written = 1, _tag(2, _FLOAT) + struct.pack("<f", value)
    elif isinstance(value, str):
        kind, written = 3, _field(4, value.encode())
    else:
        kind, written = 7, b"".join(_number(8, item) for item in value)
    return _field(1, name.encode()) + written + _number(20, kind)


def _tensor(name: str, array: npt.NDArray[Any]) -> bytes:
    data = np.asarray(array)
    return b"".join(
        [
            *(_number(1, size) for size in data.shape),
            _number(2, _element_type(data.dtype)),
            _field(8, name.encode()),
            _field(9, data.astype(data.dtype.newbyteorder("<")).tobytes()),
        ]
    )


def _value_info(name: str, dtype: npt.DTypeLike, shape: Shape) -> bytes:
    sizes = (
        _number(1, size) if isinstance(size, int) else _field(2, size.encode()) for size in shape
    )
    dimensions = b"".join(_field(1, size) for size in sizes)
    tensor = _number(1, _element_type(np.dtype(dtype))) + _field(2, dimensions)
    return _field(1, name.encode()) + _field(2, _field(1, tensor))


def _element_type(dtype: np.dtype[Any]) -> int:
    if dtype.name not in _ELEMENT_TYPES:
        raise ValueError(f"no tensors of {dtype.name}; there are {sorted(_ELEMENT_TYPES)}")
    return _ELEMENT_TYPES[dtype.name]


def _tag(number: int, wire_type: int) -> bytes:
    return _varint(number << 3 | wire_type)


def _field(number: int, data: bytes) -> bytes:
    return _tag(number, _BYTES) + _varint(len(data)) + data


def _number(number: int, value: int) -> bytes:
    return _tag(number, _VARINT) + _varint(value)


def _varint(value: int) -> bytes:
    value &= 0xFFFFFFFFFFFFFFFF  # negative numbers as two's complement of 64 bits
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
