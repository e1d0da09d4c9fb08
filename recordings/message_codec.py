"""Messages of ours as protobuf that describes itself, derived from the fields of the dataclass.

| in the dataclass | in the schema `mapstream.<Class>` |
|---|---|
| int, float, bool, str, bytes, Literal | int64, double, bool, string, bytes, string |
| an array | `Array {dtype, shape, data}`, little-endian, row by row |
| SE3 | `Transform {matrix}`: 16 numbers, row by row; a quaternion would lose digits |
| another dataclass | its message |
| tuple[X, ...] | repeated X |
| X or None | optional X |

Decoding follows the schema in the recording and matches fields by name, so a file of an older version
reads as long as the fields without a default are there. Classes are looked up by name among known ones:
mapstream's, and those that packages name under the entry point group `mapstream.messages`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Final

import numpy as np

from mapstream.recordings.message_schema import (
    PACKAGE,
    SCALARS,
    fields_of,
    message_class,
    schema_name,
    schema_of,
)
from mapstream.streams import calibration
from mapstream.streams.errors import DecodeError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages import (
    constraints,
    estimates,
    grids,
    objects,
    planes,
    sensors,
    vision,
)
from mapstream.streams.messages.sensors import Message

_ARRAY_KINDS: Final = "biuf"  # no objects: a file must not be able to name code


@cache
def _encoder_class(cls: type) -> type[Any]:
    return message_class(schema_name(cls), schema_of(cls))


def encode(message: Message) -> bytes:
    """Return a message as protobuf bytes of the schema `schema_of` its class; equal in, equal out.

    Raises:
        TypeError: If a field is of a type that has no place in a recording.
    """
    cls = type(message)
    target = _encoder_class(cls)()
    _fill(target, message)
    return bytes(target.SerializeToString(deterministic=True))


def _fill(target: Any, value: Any) -> None:  # noqa: ANN401  # protobuf has no types
    if isinstance(value, np.ndarray):
        array = value.astype(value.dtype.newbyteorder("<"), copy=False)
        target.dtype = array.dtype.str
        target.shape.extend(array.shape)
        target.data = array.tobytes()
        return
    if isinstance(value, SE3):
        target.matrix.extend(value.matrix.ravel().tolist())
        return
    cls: type = type(value)
    for field in fields_of(cls):
        content = getattr(value, field.name)
        if content is None:
            continue
        if field.kind in SCALARS:
            if field.is_repeated:
                getattr(target, field.name).extend(content)
            else:
                setattr(target, field.name, field.kind(content))  # numpy numbers become plain
        elif field.is_repeated:
            for item in content:
                _fill(getattr(target, field.name).add(), item)
        else:
            part = getattr(target, field.name)
            part.SetInParent()  # an empty message is there, too
            _fill(part, content)


def decoder(name: str, schema: bytes) -> tuple[type[Any], Callable[[memoryview], Message]]:
    """Return the message class of a schema `mapstream.<Class>`, and what decodes its messages.

    Raises:
        DecodeError: If the class is not known, or the schema is damaged.
    """
    bare = name.removeprefix(f"{PACKAGE}.")
    known = known_messages()
    if bare not in known:
        raise DecodeError(
            f"schema {name}: no such message; known: {', '.join(sorted(known))}; packages add theirs "
            "with an entry point in the group mapstream.messages"
        )
    cls = known[bare]
    protobuf = message_class(name, schema)

    def decode(data: memoryview) -> Message:
        found: Message = _read(cls, protobuf.FromString(bytes(data)))
        return found

    return cls, decode


def known_messages() -> dict[str, type[Any]]:
    """Return message classes by name."""
    known = {
        name: cls
        for module in (sensors, constraints, estimates, grids, objects, planes, vision, calibration)
        for name, cls in vars(module).items()
        if isinstance(cls, type) and is_dataclass(cls) and cls.__module__ == module.__name__
    }
    for entry in entry_points(group="mapstream.messages"):
        if entry.name not in known:
            known[entry.name] = entry.load()
    return known


def _read(cls: type, source: Any) -> Any:  # noqa: ANN401
    if cls is np.ndarray:
        return _array(source)
    if cls is SE3:
        return SE3(np.array(source.matrix).reshape(4, 4))
    present = source.DESCRIPTOR.fields_by_name
    values: dict[str, Any] = {}
    for field in fields_of(cls):
        if field.name not in present:
            if field.is_required:
                raise ValueError(
                    f"{cls.__name__}.{field.name} is missing: written by another version"
                )
            continue
        content = getattr(source, field.name)
        is_scalar = field.kind in SCALARS
        if field.is_repeated:
            values[field.name] = tuple(
                content if is_scalar else (_read(field.kind, c) for c in content)
            )
        elif field.is_optional and not source.HasField(field.name):
            values[field.name] = None
        else:
            values[field.name] = content if is_scalar else _read(field.kind, content)
    return cls(**values)


def _array(source: Any) -> np.ndarray[Any, Any]:  # noqa: ANN401
    dtype = np.dtype(source.dtype)
    if dtype.kind not in _ARRAY_KINDS:
        raise ValueError(f"an array of dtype {source.dtype!r}")
    return np.frombuffer(source.data, dtype).reshape(tuple(source.shape))
