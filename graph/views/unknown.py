"""A message of a type that nobody wrote a view for: its numbers as plots, the rest as text."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import rerun as rr

from mapstream.graph.views.scene import Drawing, Entry, Scene


def view_unknown(message: object, scene: Scene) -> Drawing:  # noqa: ARG001  # a view
    """Plot each numeric field, and write down what every field holds."""
    values = _values(message)
    numbers = {
        name: float(value)
        for name, value in values.items()
        if isinstance(value, (bool, int, float, np.number)) and name != "stamp_ns"
    }
    lines = [f"**{type(message).__name__}**", ""]
    lines += [f"- `{name}`: {_summary(value)}" for name, value in values.items()]
    text = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    plots = [Entry.of(name, rr.Scalars(number)) for name, number in numbers.items()]
    return [*plots, Entry.of("summary", text)]


def _values(message: object) -> dict[str, object]:
    if is_dataclass(message):
        return {field.name: getattr(message, field.name) for field in fields(message)}
    return {
        name: value for name, value in getattr(message, "__dict__", {}).items() if name[0] != "_"
    }


def _summary(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    if isinstance(value, (bytes, memoryview)):
        return f"{len(value)} bytes"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
