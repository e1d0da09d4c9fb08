"""A YAML 1.2 file as plain data that remembers where each key stands.

The text is composed to nodes and converted here, so that nothing but maps, lists and scalars can come
out of a file from elsewhere: no tags, no code, and no tower of aliases that fills the memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from mapstream.graph.problems import GraphError, KeyPath, Position, Problem

_MAX_VALUES = 100_000
_MAX_DEPTH = 50
_STANDARD = "tag:yaml.org,2002:"
_KINDS = {"map", "seq", "str", "bool", "int", "float", "null", "timestamp", "merge", "value"}


@dataclass(slots=True)
class Positions:
    """Where the keys of a file, and of the files it inserts, were written."""

    source: str
    places: dict[KeyPath, Position] = field(default_factory=dict)

    def known(self, path: KeyPath) -> KeyPath:
        """Return as much of a path as was written."""
        while path and path not in self.places:
            path = path[:-1]
        return path

    def of(self, path: KeyPath) -> Position:
        return self.places.get(self.known(path), Position(self.source))

    def below(self, path: KeyPath) -> Iterator[tuple[KeyPath, Position]]:
        """Return the places under a path, with what follows it."""
        n = len(path)
        return ((key[n:], place) for key, place in self.places.items() if key[:n] == path)


@dataclass(frozen=True, slots=True)
class Document:
    """A file: maps, lists and scalars, and where they stand."""

    data: Any
    positions: Positions


def read_document(text: str, source: str) -> Document:
    """Read one YAML document.

    Raises:
        GraphError: If the text is no YAML, has a key twice, a tag, or too much in it.
    """
    yaml = YAML(typ="safe", pure=True)
    try:
        node = yaml.compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Position(source, mark.line + 1, mark.column + 1) if mark else Position(source)
        reason = " ".join(part for part in (error.problem, error.context) if part)
        raise GraphError([Problem(place, (), f"not YAML: {reason}")]) from None
    except YAMLError as error:
        raise GraphError([Problem(Position(source), (), f"not YAML: {error}")]) from None
    reader = _Reader(yaml, source)
    data = None if node is None else reader.plain(node, ())
    if reader.problems:
        raise GraphError(reader.problems)
    return Document(data, reader.positions)


def read_scalar(text: str) -> Any:  # noqa: ANN401  # whatever YAML says
    """Return the value of an option, typed as in a file: `0.5`, `true`, `[a, b]`, `text`.

    Raises:
        ValueError: If the text is no YAML.
    """
    try:
        return read_document(text, "value").data
    except GraphError as error:
        raise ValueError(f"{text!r} cannot be read: {error.problems[0].message}") from None


class _Reader:
    """Converts nodes to plain data, and notes positions and problems on the way."""

    def __init__(self, yaml: YAML, source: str) -> None:
        self.positions = Positions(source)
        self.problems: list[Problem] = []
        self._yaml = yaml
        self._num_values = 0

    def plain(self, node: Node, path: KeyPath) -> Any:  # noqa: ANN401  # what the file holds
        self._num_values += 1
        if self._num_values > _MAX_VALUES or len(path) > _MAX_DEPTH:
            limit = f"more than {_MAX_VALUES} values, or {_MAX_DEPTH} levels"
            raise GraphError([Problem(self._place(node), path[:3], f"{limit}: not a graph")])
        self.positions.places.setdefault(path, self._place(node))
        kind = str(node.tag).removeprefix(_STANDARD)
        if kind not in _KINDS:
            self._refuse(node, path, f"tag {node.tag!r} is not allowed here")
            return None
        if isinstance(node, MappingNode):
            return self._map(node, path)
        if isinstance(node, SequenceNode):
            return [self.plain(child, (*path, i)) for i, child in enumerate(node.value)]
        if kind in ("bool", "int", "float", "null"):
            return self._yaml.constructor.construct_object(node)
        return node.value  # text; dates stay text, as in YAML 1.2's core schema

    def _map(self, node: MappingNode, path: KeyPath) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = key_node.value
            if not isinstance(key_node, ScalarNode) or key_node.tag != f"{_STANDARD}str":
                self._refuse(key_node, path, f"a key must be text, found {key!r}; quote it")
                continue
            key_path = (*path, key)
            if key in result:
                first = self.positions.of(key_path)
                self._refuse(key_node, key_path, f"twice in one map, first in line {first.line}")
                continue
            self.positions.places[key_path] = self._place(key_node)
            result[key] = self.plain(value_node, key_path)
        return result

    def _refuse(self, node: Node, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self._place(node), path, message))

    def _place(self, node: Node) -> Position:
        mark = node.start_mark
        return Position(self.positions.source, mark.line + 1, mark.column + 1)


def describe(value: object) -> str:
    """Return a value for a message, in the words of YAML and not too long."""
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    if isinstance(value, float) and not math.isfinite(value):
        return {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan")
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
