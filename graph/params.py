"""Parameters of a graph: their values, and `$name` and `${name}` in the file.

Values are put in after the file was read, never into its text, so that a value cannot become a key,
and a number stays a number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mapstream.graph.document import Document, Positions, describe, read_scalar
from mapstream.graph.problems import KeyPath, Problem, did_you_mean
from mapstream.graph.spec import ParamSpec

# given on the command line by position and by `--map`; a file need not declare them
BUILT_IN = {
    "recording": ParamSpec(type="path", help="the recording to read"),
    "map": ParamSpec(type="path", help="the folder of the map"),
}
_WHOLE = re.compile(r"\$([A-Za-z][A-Za-z0-9_]*)")
_INSIDE = re.compile(r"\$\$|\$\{([^}]*)\}?")
_TYPES: dict[str, Any] = {"path": str, "str": str, "int": int, "float": float, "bool": bool}
_STRICT = ConfigDict(strict=True)


def params_used(data: object) -> set[str]:
    """Return the names behind `$name` and `${name}` anywhere in a value."""
    if isinstance(data, dict):
        return set().union(*map(params_used, data.values()))
    if isinstance(data, list):
        return set().union(*map(params_used, data))
    if not isinstance(data, str):
        return set()
    whole = _WHOLE.fullmatch(data)
    found = [whole] if whole else _INSIDE.finditer(data)
    return {match[1] for match in found if match[1]}


def typed_value(name: str, spec: ParamSpec, value: object) -> Any:  # noqa: ANN401  # as spec says
    """Check a value against its parameter.

    Raises:
        ValueError: If its type or size is wrong; the message says what was expected.
    """
    unit = f" {spec.unit}" if spec.unit else ""
    try:
        result = TypeAdapter(_TYPES[spec.type], config=_STRICT).validate_python(value)
    except ValidationError:
        expected = f"expected {spec.type}, found {describe(value)}"
        raise ValueError(f"parameter {name!r}: {expected}") from None
    if spec.type == "path":
        return str(Path(result).expanduser())
    for limit, is_outside, word in (
        (spec.min, spec.min is not None and result < spec.min, "at least"),
        (spec.max, spec.max is not None and result > spec.max, "at most"),
    ):
        if is_outside:
            found = describe(result)
            raise ValueError(f"parameter {name!r}: expected {word} {limit:g}{unit}, found {found}")
    return result


def value_from_text(name: str, spec: ParamSpec, text: str) -> Any:  # noqa: ANN401  # as spec says
    """Return the value of a parameter that was given as text: an option or an environment variable."""
    return typed_value(name, spec, text if spec.type in ("path", "str") else read_scalar(text))


def placeholder(name: str, spec: ParamSpec) -> Any:  # noqa: ANN401  # as spec says
    """Return a stand-in for a value that is not known yet, for looking at a graph without running it."""
    if spec.type in ("path", "str"):
        return f"<{name}>"
    if spec.type == "bool":
        return False
    number = spec.min if spec.min is not None else min(1.0, spec.max or 1.0)
    return int(number) if spec.type == "int" else number


def fill_in(document: Document, values: Mapping[str, Any]) -> tuple[Any, list[Problem]]:
    """Return the data of a file with its parameters in their places, and what was wrong."""
    filler = _Filler(values, document.positions)
    data = {
        key: value if key == "params" else filler.fill(value, (key,))
        for key, value in document.data.items()
    }
    return data, filler.problems


class _Filler:
    def __init__(self, values: Mapping[str, Any], positions: Positions) -> None:
        self.problems: list[Problem] = []
        self._values = values
        self._positions = positions

    def fill(self, value: Any, path: KeyPath) -> Any:  # noqa: ANN401  # any part of a file
        if isinstance(value, dict):
            return {key: self.fill(item, (*path, key)) for key, item in value.items()}
        if isinstance(value, list):
            return [self.fill(item, (*path, i)) for i, item in enumerate(value)]
        if not isinstance(value, str) or "$" not in value:
            return value
        whole = _WHOLE.fullmatch(value)
        if whole:
            return self._value(whole[1], path)
        return _INSIDE.sub(lambda match: self._text(match, path), value)

    def _text(self, match: re.Match[str], path: KeyPath) -> str:
        return "$" if match[0] == "$$" else str(self._value(match[1], path))

    def _value(self, name: str, path: KeyPath) -> Any:  # noqa: ANN401  # of any parameter
        if name not in self._values:
            hint = did_you_mean(name, self._values)
            message = f"no parameter {name!r}{hint} (a dollar sign itself is written $$)"
            self.problems.append(Problem(self._positions.of(path), path, message))
        return self._values.get(name, "")
