"""Parameters of a graph: their values, and `$name` and `${name}` in the file.

Values are put in after the file was read, never into its text, so that a value cannot become a key,
and a number stays a number.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mapstream.graph.document import Document, Positions, describe, read_scalar
from mapstream.graph.problems import KeyPath, Position, Problem, did_you_mean
from mapstream.graph.spec import ParamSpec

# given on the command line by position and by `--map`; a file need not declare them
BUILT_IN = {
    "recording": ParamSpec(type="path", help="the recording to read"),
    "map": ParamSpec(type="path", help="the folder of the map"),
}
_WHOLE = re.compile(r"\$([A-Za-z][A-Za-z0-9_]*)")
_INSIDE = re.compile(r"\$\$|\$\{([^}]*)\}?")
_TYPES: dict[str, Any] = {"path": str, "str": str, "int": int, "float": float, "bool": bool}
_STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def _params_used(data: object) -> set[str]:
    """Return the names behind `$name` and `${name}` anywhere in a value."""
    if isinstance(data, dict):
        return set().union(*map(_params_used, data.values()))
    if isinstance(data, list):
        return set().union(*map(_params_used, data))
    if not isinstance(data, str):
        return set()
    whole = _WHOLE.fullmatch(data)
    found = [whole] if whole else _INSIDE.finditer(data)
    return {match[1] for match in found if match[1]}


def _typed_value(name: str, spec: ParamSpec, value: object) -> Any:  # noqa: ANN401  # as spec says
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


def _value_from_text(name: str, spec: ParamSpec, text: str) -> Any:  # noqa: ANN401  # as spec says
    """Return the value of a parameter that was given as text: an option or an environment variable."""
    return _typed_value(name, spec, text if spec.type in ("path", "str") else read_scalar(text))


def _placeholder(name: str, spec: ParamSpec) -> Any:  # noqa: ANN401  # as spec says
    """Return a stand-in for a value that is not known yet, for looking at a graph without running it."""
    if spec.type in ("path", "str"):
        return f"<{name}>"
    if spec.type == "bool":
        return False
    number = spec.min if spec.min is not None else min(1.0, spec.max or 1.0)
    return int(number) if spec.type == "int" else number


@dataclass(frozen=True, slots=True)
class Given:
    """The values of parameters: text from the command line, and `with:` of a sub-graph."""

    texts: Mapping[str, str]
    values: Mapping[str, Any] | None = None  # of a sub-graph, which gets no texts but the built-in
    needs_values: bool = True

    def values_of(
        self, specs: Mapping[str, ParamSpec], document: Document
    ) -> tuple[dict[str, Any], list[Problem]]:
        """Return the values of all parameters, and what is missing or wrong; that gets a stand-in."""
        used = _params_used(document.data)
        known = {name: s for name, s in BUILT_IN.items() if name in used} | dict(specs)
        problems = self._unknown(known, document.positions.source)
        values = {}
        for name, spec in known.items():
            try:
                values[name] = self._value(name, spec)
            except ValueError as error:
                values[name] = _placeholder(name, spec)
                path = ("params", name)
                problems.append(Problem(document.positions.of(path), path, str(error)))
        return values, problems

    def _unknown(self, known: Mapping[str, ParamSpec], source: str) -> list[Problem]:
        if self.values is not None:
            given = dict.fromkeys(self.values, source)
        else:
            given = {name: _option(name, text) for name, text in self.texts.items()}
        return [
            Problem(Position(place), (), f"no parameter {name!r}{did_you_mean(name, known)}")
            for name, place in given.items()
            if name not in known
        ]

    def _value(self, name: str, spec: ParamSpec) -> Any:  # noqa: ANN401  # as spec says
        if self.values is not None and name in self.values:
            return _typed_value(name, spec, self.values[name])
        if name in self.texts and (self.values is None or name in BUILT_IN):
            return _value_from_text(name, spec, self.texts[name])
        if spec.env is not None and spec.env in os.environ:
            return _value_from_text(name, spec, os.environ[spec.env])
        if spec.default is not None:
            return _typed_value(name, spec, spec.default)
        if not self.needs_values:
            return _placeholder(name, spec)
        raise ValueError(f"no value{_how_to_give(name, spec)}")


def _option(name: str, text: str) -> str:
    """Return how the command line gave a parameter."""
    ways = {"recording": f"RECORDING {text}", "map": f"--map {text}"}
    return ways.get(name, f"--param {name}={text}")


def _how_to_give(name: str, spec: ParamSpec) -> str:
    ways = {"recording": "RECORDING after the graph", "map": "--map DIR"}
    how = ways.get(name, f"--param {name}=VALUE")
    env = f", or set {spec.env}" if spec.env else ""
    about = f" ({spec.help})" if spec.help else ""
    return f"; give {how}{env}{about}"


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
