"""A planned graph as a drawing: Mermaid for documents, text for terminals."""

from __future__ import annotations

from collections.abc import Iterator

from mapstream.graph.plan import Edge, Node, Plan
from mapstream.graph.wiring import type_name
from mapstream.operators.operator import NoPorts

_COLOURS = {"inline": "#eef2f7", "thread": "#e3f1e3", "process": "#fbe9d7"}


def mermaid(plan: Plan) -> str:
    """Return a Mermaid flowchart: one box per operator in the colour of its placement, one arrow per edge."""
    ids = {name: f"n{i}" for i, name in enumerate(plan.nodes)}
    lines = ["flowchart LR"]
    lines += [f"  {ids[name]}{_box(node)}:::{node.placement}" for name, node in plan.nodes.items()]
    for edge in plan.edges:
        arrow = "-.->" if edge.is_feedback else "-->"
        label = f"{_ports(edge)}<br/>{type_name(edge.message_type)}{_limits(edge)}"
        lines.append(f'  {ids[edge.from_node]} {arrow}|"{label}"| {ids[edge.to_node]}')
    used = {node.placement for node in plan.nodes.values()}
    lines += [f"  classDef {p} fill:{c},stroke:#555" for p, c in _COLOURS.items() if p in used]
    return "\n".join(lines) + "\n"


def text(plan: Plan) -> str:
    """Return one paragraph per operator, in the order of the flow, with what it sends where."""
    count = f"{len(plan.nodes)} operators, {len(plan.edges)} edges"
    lines = [f"{plan.name}: {count}, profile {plan.profile_name}"]
    for name, node in plan.nodes.items():
        workers = f" x {node.workers}" if node.workers > 1 else ""
        lines.append(f"{name}  ({node.use}, {node.placement}{workers})")
        lines += [f"  {line}" for line in _sent(plan, node)]
    return "\n".join(lines) + "\n"


def _sent(plan: Plan, node: Node) -> Iterator[str]:
    for port in node.signature.outputs.values():
        edges = [e for e in plan.edges if (e.from_node, e.from_port) == (node.name, port.name)]
        for edge in edges:
            feedback = ", feedback" if edge.is_feedback else ""
            to = f"{edge.to_node}.{edge.to_port}"
            yield f"{port.name}: {type_name(edge.message_type)} -> {to}{_limits(edge)}{feedback}"
        if not edges:
            yield f"{port.name}: {type_name(port.message_type)} (not connected)"


def _box(node: Node) -> str:
    label = f'"{node.name}<br/><i>{node.use}</i>"'
    if node.is_source:
        return f"([{label}])"
    return f"[[{label}]]" if node.signature.outputs_type is NoPorts else f"[{label}]"


def _ports(edge: Edge) -> str:
    return edge.to_port if edge.to_port == edge.from_port else f"{edge.from_port} to {edge.to_port}"


def _limits(edge: Edge) -> str:
    """Return what is special about an edge's queue; nothing for one that blocks."""
    return "" if edge.limits.policy == "block" else f", {edge.limits.policy}"
