"""Whether what an operator sends is what the next one expects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from types import UnionType
from typing import Any, Union, get_args, get_origin

from mapstream.operators.signature import Signature
from mapstream.streams.messages.sensors import Message


def accepts(expected: Any, sent: Any) -> bool:  # noqa: ANN401  # annotations of ports
    """Return whether a port for `expected` takes messages of type `sent`.

    The same class, a subclass, a member of a union; `Message` takes all. Nothing is converted.
    A sender of `Any` is taken too: the runtime looks at its first message.
    """
    if expected is Any or expected is Message or sent is Any:
        return True
    if get_origin(sent) in (Union, UnionType):
        return all(accepts(expected, kind) for kind in get_args(sent))
    if get_origin(expected) in (Union, UnionType):
        return any(accepts(kind, sent) for kind in get_args(expected))
    return isinstance(expected, type) and isinstance(sent, type) and issubclass(sent, expected)


def type_name(kind: Any) -> str:  # noqa: ANN401  # an annotation
    """Return a message type as a person writes it: `LidarScan`, `Map | Odometry`."""
    if get_origin(kind) in (Union, UnionType):
        return " | ".join(map(type_name, get_args(kind)))
    return getattr(kind, "__name__", str(kind))


def senders_of(expected: Any, signatures: Mapping[str, Signature]) -> list[str]:  # noqa: ANN401
    """Return the outputs `operator.port` whose messages a port for `expected` takes."""
    return [
        f"{name}.{port.name}"
        for name, signature in signatures.items()
        for port in signature.outputs.values()
        if accepts(expected, port.message_type)
    ]


def flow_order(names: Iterable[str], edges: Iterable[tuple[str, str]]) -> list[str]:
    """Return the names so that the sender of each edge comes before its receiver.

    Raises:
        CycleFound: If edges form a cycle.
    """
    sorter: TopologicalSorter[str] = TopologicalSorter(dict.fromkeys(names, ()))
    for sender, receiver in edges:
        sorter.add(receiver, sender)
    try:
        return list(sorter.static_order())
    except CycleError as error:
        raise CycleFound(error.args[1]) from None


class CycleFound(Exception):  # noqa: N818  # says what happened, as StopIteration does
    """Edges that lead back to where they came from; `names` starts and ends with the same one."""

    def __init__(self, names: list[str]) -> None:
        super().__init__(" -> ".join(names))
        self.names = names

    def pairs(self) -> Iterator[tuple[str, str]]:
        return zip(self.names, self.names[1:], strict=False)
