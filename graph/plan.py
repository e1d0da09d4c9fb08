"""What a run will consist of. Planning checks everything and opens nothing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.load import Graph
from mapstream.graph.problems import GraphError, KeyPath, Position, Problem, did_you_mean
from mapstream.graph.spec import InputSpec, LogSpec, OnErrorSpec, OperatorSpec, ProfileSpec
from mapstream.graph.validation import problems_of
from mapstream.graph.wiring import CycleFound, accepts, flow_order, senders_of, type_name
from mapstream.operators.operator import NoPorts, OperatorConfig, Placement
from mapstream.operators.signature import Port, Signature, signature_of
from mapstream.streams.channel import Limits
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """One operator of a run."""

    name: str  # `outer/inner` for those of a sub-graph
    use: str  # its name in the catalogue
    signature: Signature
    config: OperatorConfig
    placement: Placement = "inline"
    workers: int = 1
    on_error: OnErrorSpec | None = None  # None: live sources restart, all else stops the run
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
    profile_name: str = "replay"
    log: LogSpec = field(default_factory=LogSpec)
    warnings: tuple[str, ...] = ()


def plan(graph: Graph, catalogue: Catalogue | None = None) -> Plan:
    """Check a graph, and return what to run.

    Raises:
        GraphError: If anything in it cannot work: all problems at once, each with file and line.
    """
    planner = _Planner(graph, catalogue or Catalogue())
    result = planner.plan()
    if planner.problems:
        raise GraphError(planner.problems)
    return result


class _Planner:
    """Collects nodes, edges and problems of one graph."""

    def __init__(self, graph: Graph, catalogue: Catalogue) -> None:
        self.problems: list[Problem] = []
        self._graph = graph
        self._catalogue = catalogue
        self._operators = {n: o for n, o in graph.spec.operators.items() if o.enabled}
        self._nodes: dict[str, Node] = {}

    def plan(self) -> Plan:
        for name, operator in self._operators.items():
            node = self._node(name, operator)
            if node is not None:
                self._nodes[name] = node
        edges = [edge for node in self._nodes.values() for edge in self._edges_to(node)]
        order = self._order(edges)
        return Plan(
            name=self._graph.spec.name,
            nodes={name: self._nodes[name] for name in order},
            edges=tuple(edges),
            profile=self._graph.profile,
            profile_name=self._graph.profile_name,
            log=self._graph.spec.log,
            warnings=tuple(self._warnings(edges)),
        )

    def _problem(self, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self._graph.positions.of(path), path, message))

    def _node(self, name: str, operator: OperatorSpec) -> Node | None:
        """Return an operator with its config; None after noting why there is none."""
        path: KeyPath = ("operators", name)
        try:
            operator_type = self._catalogue.get(operator.use)
            config_type = signature_of(operator_type).config_type
        except ConfigError as error:
            self._problem((*path, "use"), str(error))
            return None
        try:
            config = config_type.model_validate(operator.config)
            signature = signature_of(operator_type, config)
        except ValidationError as error:
            positions = self._graph.positions
            self.problems += problems_of(error, config_type, (*path, "config"), positions)
            return None
        except ConfigError as error:  # a config that names ports which cannot be
            self._problem((*path, "config"), str(error))
            return None
        placement = operator.run.where or operator_type.placement
        if operator.run.workers > 1 and placement != "thread":
            message = f"workers are threads; {name!r} runs {placement}: write `where: thread`"
            self._problem((*path, "run", "workers"), message)
        return Node(
            name=name,
            use=operator.use,
            signature=signature,
            config=config,
            placement=placement,
            workers=operator.run.workers,
            on_error=operator.on_error,
            position=self._graph.positions.of(path),
        )

    def _edges_to(self, node: Node) -> Iterable[Edge]:
        wires = self._operators[node.name].in_
        inputs = node.signature.inputs
        for port_name, wire in wires.items():
            if port_name not in inputs:
                hint = did_you_mean(port_name, inputs) if inputs else "; it is a source"
                message = f"{node.use} has no input {port_name!r}{hint}"
                self._problem(("operators", node.name, "in", port_name), message)
            elif (edge := self._edge(node, inputs[port_name], wire)) is not None:
                yield edge
        for port in inputs.values():
            if port.name not in wires and not port.is_optional:
                self._unconnected(node, port)
        if inputs and not wires and all(port.is_optional for port in inputs.values()):
            self._problem(
                ("operators", node.name), f"connect at least one of the inputs {', '.join(inputs)}"
            )

    def _unconnected(self, node: Node, port: Port) -> None:
        there = senders_of(
            port.message_type, {n: o.signature for n, o in self._nodes.items() if n != node.name}
        )
        hint = f"; {' or '.join(there)} would fit" if there else "; no operator here sends that"
        message = f"input {port.name!r} ({type_name(port.message_type)}) is not connected{hint}"
        self._problem(("operators", node.name), message)

    def _edge(self, node: Node, port: Port, wire: InputSpec) -> Edge | None:
        """Return the channel to an input; None where there is none, after noting why."""
        path: KeyPath = ("operators", node.name, "in", port.name)
        sender_name, _, output = wire.from_.partition(".")
        spec = self._graph.spec.operators.get(sender_name)
        if spec is None:
            hint = did_you_mean(sender_name, self._operators)
            self._problem(path, f"no operator {sender_name!r}{hint}")
            return None
        if not spec.enabled:
            if not port.is_optional:
                message = f"{sender_name!r} is not enabled, and this input needs its messages"
                self._problem(path, message)
            return None
        sender = self._nodes.get(sender_name)
        if sender is None:
            return None  # its own problem was noted
        outputs = sender.signature.outputs
        if output not in outputs:
            hint = did_you_mean(output, outputs) if outputs else "; it is a sink"
            self._problem(path, f"{sender_name} ({sender.use}) has no output {output!r}{hint}")
            return None
        sent = outputs[output].message_type
        if not accepts(port.message_type, sent):
            expected = type_name(port.message_type)
            message = f"{wire.from_} sends {type_name(sent)}, but {node.name}.{port.name} takes {expected}"
            self._problem(path, message)
            return None
        profile = self._graph.profile
        defaults = profile.sources.over(profile.edges) if sender.is_source else profile.edges
        return Edge(
            from_node=sender_name,
            from_port=output,
            to_node=node.name,
            to_port=port.name,
            message_type=port.message_type if sent is Any else sent,
            limits=wire.over(defaults).to_limits(),
            is_feedback=wire.feedback,
            is_unchecked=sent is Any and port.message_type is not Any,
        )

    def _order(self, edges: Iterable[Edge]) -> list[str]:
        """Return the nodes in the order of the flow, and note a cycle."""
        pairs = {(e.from_node, e.to_node): e for e in edges if not e.is_feedback}
        try:
            return flow_order(self._nodes, pairs)
        except CycleFound as cycle:
            closing = pairs[list(cycle.pairs())[-1]]
            self._problem(
                ("operators", closing.to_node, "in", closing.to_port),
                f"a cycle: {cycle}; if an operator in it expects its own results back, write "
                "`{from: ..., feedback: true}` at that input",
            )
            return list(self._nodes)

    def _warnings(self, edges: Iterable[Edge]) -> Iterable[str]:
        if self._graph.profile.clock.from_ == "data":
            for edge in edges:
                if edge.limits.policy in ("drop_oldest", "drop_newest", "latest"):
                    policy = edge.limits.policy
                    yield f"{edge.name}: the policy {policy} drops by speed; two runs may differ"
