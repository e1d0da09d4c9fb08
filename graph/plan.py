"""What a run will consist of. Planning checks everything and opens nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mapstream.graph.problems import Position
from mapstream.graph.spec import LogSpec, OnErrorSpec, ProfileSpec
from mapstream.operators.operator import NoPorts, OperatorConfig, Placement
from mapstream.operators.signature import Signature
from mapstream.streams.channel import Limits


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """One operator of a run."""

    name: str  # `outer/inner` for those of a sub-graph
    use: str  # its name in the catalogue
    signature: Signature
    config: OperatorConfig
    placement: Placement = "inline"
    workers: int = 1
    on_error: OnErrorSpec | None = (
        None  # None: sources of a live run restart, all else stops the run
    )
    position: Position | None = None  # in the graph file

    @property
    def is_source(self) -> bool:
        return self.signature.inputs_type is NoPorts


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """One channel of a run: from an output to an input."""

    from_node: str
    from_port: str
    to_node: str
    to_port: str
    message_type: Any  # what the consumer may rely on
    limits: Limits = field(default_factory=Limits)
    is_feedback: bool = False
    is_unchecked: bool = False  # the sender's type is not known: look at the first message

    @property
    def name(self) -> str:
        return f"{self.from_node}.{self.from_port} -> {self.to_node}.{self.to_port}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A checked graph: nodes in an order in which every sender comes before its receivers."""

    name: str
    nodes: dict[str, Node]
    edges: tuple[Edge, ...]
    profile: ProfileSpec = field(default_factory=ProfileSpec)
    log: LogSpec = field(default_factory=LogSpec)
    warnings: tuple[str, ...] = ()
