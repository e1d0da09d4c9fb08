"""The protobuf schema of a message class, derived from the fields of the dataclass."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from mapstream.streams.errors import DecodeError
from mapstream.streams.geometry import SE3

PACKAGE: Final = "mapstream"
SCALARS: Final[dict[type, int]] = {
    int: FieldDescriptorProto.TYPE_INT64,
    float: FieldDescriptorProto.TYPE_DOUBLE,
    bool: FieldDescriptorProto.TYPE_BOOL,
    str: FieldDescriptorProto.TYPE_STRING,
    bytes: FieldDescriptorProto.TYPE_BYTES,
}


@dataclass(frozen=True, slots=True)
class MessageField:
    """One field of a dataclass: what it holds, and how often."""

    name: str
    kind: type  # a scalar, np.ndarray, SE3 or a dataclass
    is_repeated: bool
    is_optional: bool
    is_required: bool  # has no default


@cache
def fields_of(cls: type) -> tuple[MessageField, ...]:
    """Return the fields of a dataclass.

    Raises:
        TypeError: If one is of a type that has no place in a recording.
    """
    hints = get_type_hints(cls)
    found = []
    for field in fields(cls):
        annotation, is_optional, is_repeated = hints[field.name], False, False
        if get_origin(annotation) in (Union, UnionType):
            options = [a for a in get_args(annotation) if a is not NoneType]
            annotation, is_optional = options[0] if len(options) == 1 else annotation, True
        if get_origin(annotation) is tuple:
            annotation, is_repeated = get_args(annotation)[0], True
        if get_origin(annotation) is Literal:
            annotation = str
        kind = get_origin(annotation) or annotation
        alias = getattr(kind, "__value__", None)  # numpy's NDArray, where Python has type aliases
        kind = get_origin(alias) or kind
        if kind not in (np.ndarray, SE3, *SCALARS) and not is_dataclass(kind):
            raise TypeError(f"{cls.__name__}.{field.name}: no way to write {annotation}")
        is_required = field.default is MISSING and field.default_factory is MISSING
        found.append(MessageField(field.name, kind, is_repeated, is_optional, is_required))
    return tuple(found)


def schema_name(cls: type[Any]) -> str:
    """Return the name of a message's schema in recordings."""
    return f"{PACKAGE}.{cls.__name__}"


@cache
def schema_of(cls: type) -> bytes:
    """Return the serialized FileDescriptorSet that describes a message class and all that is in it.

    Raises:
        TypeError: If a field is of a type that has no place in a recording.
    """
    file = FileDescriptorProto(
        name=f"{PACKAGE}/{cls.__name__}.proto", package=PACKAGE, syntax="proto3"
    )
    _describe(cls, file)
    return bytes(FileDescriptorSet(file=[file]).SerializeToString(deterministic=True))


def _describe(cls: type, file: FileDescriptorProto) -> None:
    """Add a message and those inside it, each once."""
    name = _message_name(cls)
    if any(known.name == name for known in file.message_type):
        return
    message = file.message_type.add(name=name)
    if cls is np.ndarray:
        _add(message, "dtype", FieldDescriptorProto.TYPE_STRING)
        _add(message, "shape", FieldDescriptorProto.TYPE_INT64).label = 3
        _add(message, "data", FieldDescriptorProto.TYPE_BYTES)
        return
    if cls is SE3:
        _add(message, "matrix", FieldDescriptorProto.TYPE_DOUBLE).label = 3
        return
    for field in fields_of(cls):
        scalar = SCALARS.get(field.kind)
        added = _add(message, field.name, scalar or FieldDescriptorProto.TYPE_MESSAGE)
        if scalar is None:
            added.type_name = f".{PACKAGE}.{_message_name(field.kind)}"
            _describe(field.kind, file)
        if field.is_repeated:
            added.label = FieldDescriptorProto.LABEL_REPEATED
        elif field.is_optional and scalar is not None:  # messages know whether they are there
            added.proto3_optional = True
            added.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{field.name}")


def _message_name(cls: type) -> str:
    return {np.ndarray: "Array", SE3: "Transform"}.get(cls, cls.__name__)


def _add(message: DescriptorProto, name: str, kind: int) -> FieldDescriptorProto:
    field: FieldDescriptorProto = message.field.add(
        name=name,
        number=len(message.field) + 1,
        type=kind,
        label=FieldDescriptorProto.LABEL_OPTIONAL,
    )
    return field


def message_class(name: str, schema: bytes) -> type[Any]:
    """Make the protobuf class of a schema.

    Raises:
        DecodeError: If the bytes do not describe it.
    """
    pool = DescriptorPool()
    try:
        for file in FileDescriptorSet.FromString(schema).file:
            pool.Add(file)
        made: type[Any] = GetMessageClass(pool.FindMessageTypeByName(name))
    except Exception as error:  # protobuf raises what it likes on bad descriptors
        raise DecodeError(f"schema {name}: its descriptor is damaged: {error}") from error
    return made
