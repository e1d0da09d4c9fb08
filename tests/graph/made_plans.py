"""Plans for tests, written as operators and edges instead of YAML."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from mapstream.graph.plan import Edge, Node, Plan
from mapstream.graph.spec import OnErrorSpec
from mapstream.operators.operator import Operator, OperatorConfig, Placement
from mapstream.operators.signature import signature_of
from mapstream.streams.channel import Limits


def node(
    operator: type[Operator[Any, Any]],
    placement: Placement = "inline",
    workers: int = 1,
    on_error: OnErrorSpec | None = None,
    **config: object,
) -> Node:
    """Return a node without a name; `make_plan` gives it one."""
    config_type = signature_of(operator).config_type
    values: OperatorConfig = config_type.model_validate(config)
    return Node(
        name="",
        use=operator.__name__,
        signature=signature_of(operator, values),
        config=values,
        placement=placement,
        workers=workers,
        on_error=on_error,
    )


def make_plan(
    nodes: dict[str, Node],
    *edges: str,
    limits: Limits | None = None,
    limits_of: dict[str, Limits] | None = None,
) -> Plan:
    """Connect nodes: `"source.blocks -> step.blocks"`, with `feedback ` before one that closes a cycle."""
    made = []
    for text in edges:
        sender, _, receiver = text.removeprefix("feedback ").partition(" -> ")
        from_node, from_port = sender.split(".")
        to_node, to_port = receiver.split(".")
        made.append(
            Edge(
                from_node=from_node,
                from_port=from_port,
                to_node=to_node,
                to_port=to_port,
                message_type=nodes[from_node].signature.outputs[from_port].message_type,
                limits=(limits_of or {}).get(text, limits or Limits()),
                is_feedback=text.startswith("feedback "),
            )
        )
    named = {
        name: Node(**{field: getattr(n, field) for field in Node.__slots__} | {"name": name})
        for name, n in nodes.items()
    }
    return Plan(name="test", nodes=named, edges=tuple(made))


def chain(**nodes: Node) -> Plan:
    """Connect the `blocks` of each node to the next."""
    names = list(nodes)
    return make_plan(nodes, *(f"{a}.blocks -> {b}.blocks" for a, b in pairwise(names)))
