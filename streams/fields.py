"""Reading typed values out of YAML, with errors that name the file, the line and the key.

It reads the nodes of the file rather than values made of them, since a sensor's id such as
`00000000000000000000000000000012` or `12e4...` is no number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError

R = TypeVar("R")


class Fields:
    """One mapping of a YAML 1.2 file."""

    def __init__(self, path: Path, where: str, node: MappingNode) -> None:
        """Index a mapping.

        Raises:
            ConfigError: If a key occurs twice.
        """
        self._path = path
        self._where = where
        self._node = node
        self._keys: dict[str, Node] = {}
        self._values: dict[str, Node] = {}
        self._read: set[str] = set()
        for key, value in node.value:
            if key.value in self._keys:
                raise self.error(key.value, f"is here twice, also in line {_line(key)}")
            self._keys[key.value], self._values[key.value] = key, value

    @classmethod
    def of_file(cls, path: Path) -> Fields:
        """Read a file whose top level is a mapping.

        Raises:
            ConfigError: If it cannot be read, is no YAML, or is no mapping.
        """
        try:
            return cls.of_bytes(path.read_bytes(), path)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error

    @classmethod
    def of_bytes(cls, content: bytes, path: Path) -> Fields:
        """Read what is or might be such a file; the path is for messages.

        Raises:
            ConfigError: If it is no YAML, or no mapping.
        """
        try:
            node = YAML(typ="safe", pure=True).compose(content.decode("utf-8"))
        except (YAMLError, UnicodeDecodeError) as error:
            mark = getattr(error, "problem_mark", None)
            line = "" if mark is None else f":{mark.line + 1}"
            raise ConfigError(f"{path}{line}: {getattr(error, 'problem', error)}") from error
        if not isinstance(node, MappingNode):
            raise ConfigError(f"{path}: expected keys and values at the top")
        return cls(path, "", node)

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def error(self, key: str, problem: str) -> ConfigError:
        """Return an error about the value of a key, or about the whole mapping if the key is absent."""
        line = _line(self._keys.get(key, self._node))
        return ConfigError(f"{self._path}:{line}: {self._name(key)}: {problem}")

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text as it is written."""
        node = self._get(key, optional=default is not None)
        if default is not None and (node is None or _kind(node) == "null"):
            return default
        if not isinstance(node, ScalarNode) or _kind(node) in ("null", "bool"):
            raise self.error(key, f"expected a text, got {_shown(node)}")
        return str(node.value)

    def number(self, key: str) -> float:
        """Return a finite number."""
        node = self._get(key)
        value = _number(node)
        if value is None:
            raise self.error(key, f"expected a number, got {_shown(node)}")
        return value

    def optional_number(self, key: str) -> float | None:
        """Return a number, or None if the key is absent."""
        return self.number(key) if key in self else None

    def integer(self, key: str, default: int | None = None) -> int:
        """Return an integer."""
        node = self._get(key, optional=default is not None)
        if node is None and default is not None:
            return default
        if node is None or _kind(node) != "int" or _number(node) is None:
            raise self.error(key, f"expected an integer, got {_shown(node)}")
        return int(node.value)

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """Return an array, written as nested or flat lists, alone or under `data` as maplab does."""
        array = self.vector(key)
        if array.size != np.prod(shape):
            raise self.error(key, f"expected {int(np.prod(shape))} numbers, got {array.size}")
        return array.reshape(shape)

    def vector(self, key: str) -> FloatArray:
        """Return a flat array of any length, written as `matrix` says."""
        node = self._get(key)
        if isinstance(node, MappingNode):
            return Fields(self._path, self._name(key), node).vector("data")
        numbers = [_number(leaf) for leaf in _leaves(node)]
        if node is None or not isinstance(node, SequenceNode) or None in numbers:
            raise self.error(key, f"expected a list of numbers, got {_shown(node)}")
        return np.array(numbers, dtype=np.float64)

    def mapping(self, key: str) -> Fields:
        """Return the mapping below a key."""
        node = self._get(key)
        if not isinstance(node, MappingNode):
            raise self.error(key, f"expected keys and values, got {_shown(node)}")
        return Fields(self._path, self._name(key), node)

    def items(self, key: str) -> Iterator[Fields]:
        """Yield the mappings of a list; none if the key is absent."""
        node = self._get(key, optional=True)
        if node is None:
            return
        if not isinstance(node, SequenceNode):
            raise self.error(key, f"expected a list, got {_shown(node)}")
        for i, item in enumerate(node.value):
            if not isinstance(item, MappingNode):
                raise self.error(key, f"item {i} has no keys and values but is {_shown(item)}")
            yield Fields(self._path, f"{self._name(key)}[{i}]", item)

    def build(self, key: str, make: Callable[[], R]) -> R:
        """Call a constructor; what it refuses becomes an error about a key.

        Raises:
            ConfigError: If the constructor raises ValueError.
        """
        try:
            return make()
        except ValueError as error:
            raise self.error(key, str(error)) from error

    def unread(self) -> list[str]:
        """Return the keys that nobody asked for, with file and line."""
        return [
            f"{self._path}:{_line(node)}: {self._name(key)}"
            for key, node in self._keys.items()
            if key not in self._read
        ]

    def _name(self, key: str) -> str:
        return f"{self._where}.{key}" if self._where else key

    def _get(self, key: str, *, optional: bool = False) -> Node | None:
        self._read.add(key)
        if key not in self and not optional:
            raise self.error(key, "is missing")
        return self._values.get(key)


def _line(node: Node) -> int:
    return int(node.start_mark.line) + 1


def _kind(node: Node) -> str:
    """Return what a plain scalar is by YAML 1.2: int, float, bool, null, str; or seq, map."""
    return str(node.tag).rpartition(":")[2]


def _number(node: Node | None) -> float | None:
    if node is None or _kind(node) not in ("int", "float"):
        return None
    try:
        value = float(node.value)
    except ValueError:  # octal, hexadecimal, sexagesimal
        return None
    return value if np.isfinite(value) else None


def _leaves(node: Node | None) -> Iterator[Node]:
    if isinstance(node, SequenceNode):
        for item in node.value:
            yield from _leaves(item)
    elif node is not None:
        yield node


def _shown(node: Node | None) -> str:
    if isinstance(node, ScalarNode):
        return repr(node.value)
    return "keys and values" if isinstance(node, MappingNode) else "a list"
