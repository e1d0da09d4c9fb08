"""What pydantic finds wrong with a file, told by file, line and key."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from mapstream.graph.document import Positions, describe
from mapstream.graph.problems import KeyPath, Problem, did_you_mean


def problems_of(
    error: ValidationError, model: type[BaseModel], path: KeyPath, positions: Positions
) -> list[Problem]:
    """Return the problems of a value at `path` that was to become a `model`.

    Alternatives that all failed at one key (a union) become one problem.
    """
    messages: dict[KeyPath, list[str]] = {}
    for entry in error.errors(include_url=False, include_context=False):
        where: KeyPath = entry["loc"]
        message = _message(entry["type"], entry["msg"], entry["input"])
        if entry["type"] == "extra_forbidden":
            message = f"unknown key{did_you_mean(str(where[-1]), _keys_at(model, where[:-1]))}"
        full = (*path, *where)
        if entry["type"] != "missing":  # pydantic adds names of alternatives behind the last key
            full = positions.known(full) or full
        told = messages.setdefault(full, [])
        if message not in told:
            told.append(message)
    return [Problem(positions.of(p), p, " or ".join(told)) for p, told in messages.items()]


def _message(kind: str, message: str, value: object) -> str:
    if kind == "missing":
        return "is missing"
    text = message.removeprefix("Value error, ").removeprefix("Assertion failed, ")
    text = text.replace("Input should be", "should be")
    return text if isinstance(value, (dict, list)) else f"{text}, found {describe(value)}"


def _keys_at(model: type[BaseModel], path: Iterable[str | int]) -> list[str]:
    """Return the keys that the model knows at a path of keys."""
    kinds: list[Any] = [model]
    for key in path:
        kinds = [below for kind in kinds for below in _below(kind, key)]
    found = [kind for kind in kinds if _is_model(kind)]
    return [name for kind in found for name in _fields(kind)]


def _below(kind: Any, key: str | int) -> list[Any]:  # noqa: ANN401  # any annotation
    """Return what the annotation of a value says of the value under one of its keys."""
    if _is_model(kind):
        return _alternatives(_fields(kind)[str(key)]) if str(key) in _fields(kind) else [kind]
    arguments = get_args(kind)
    return _alternatives(arguments[-1]) if arguments else []


def _alternatives(annotation: Any) -> list[Any]:  # noqa: ANN401  # any annotation
    if get_origin(annotation) in (dict, list, tuple) or not get_args(annotation):
        return [annotation]
    if hasattr(annotation, "__metadata__"):  # Annotated
        return _alternatives(get_args(annotation)[0])
    return [kind for option in get_args(annotation) for kind in _alternatives(option)]


def _fields(model: type[BaseModel]) -> dict[str, Any]:
    return {field.alias or name: field.annotation for name, field in model.model_fields.items()}


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
