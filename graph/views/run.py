"""How a run goes: the operator graph itself, and plots of rates, queues and load."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import rerun as rr

from mapstream.graph.metrics import EdgeSnapshot, OperatorSnapshot, Snapshot
from mapstream.graph.plan import Plan
from mapstream.graph.views.colors import ramp_colors
from mapstream.graph.views.scene import Columns, Drawing, Entry, Scene

GRAPH = "/run/graph"
_COLUMN, _ROW = 240.0, 85.0  # distances between nodes of the drawing
_FAILED = 0xFF5252FF


def operator_graph(plan: Plan) -> list[Entry]:
    """Return the drawing of the operators, from left to right as messages flow."""
    places = _places(plan)
    names = list(plan.nodes)
    nodes = rr.GraphNodes(names, positions=[places[name] for name in names])
    pairs = list(dict.fromkeys((edge.from_node, edge.to_node) for edge in plan.edges))
    edges = rr.GraphEdges(pairs, graph_type="directed")
    labels = rr.GraphNodes.from_fields(labels=[f"{n.name}\n{n.use}" for n in plan.nodes.values()])
    # Labels change with time, and what is static hides what is not.
    return [Entry.of(GRAPH, nodes, edges, is_static=True), Entry.of(GRAPH, labels)]


def graph_extent(plan: Plan) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of x and y that hold the drawing, labels included."""
    x, y = zip(*_places(plan).values(), strict=True)
    return (min(x) - _COLUMN / 2, max(x) + _COLUMN / 2), (min(y) - _ROW / 2, max(y) + _ROW / 2)


def view_snapshot(snapshot: Snapshot, scene: Scene) -> Drawing:
    """Plot rates, queues and load, and write them into the operator graph."""
    previous: dict[str, tuple[float, int]] = scene.remember("previous", {})
    drawing: list[Entry | Columns] = [*_styles(snapshot)] if scene.once("styles") else []
    for edge in snapshot.edges:
        entity = _entity(edge.name)
        wall_s, sent = previous.get(edge.name, (0.0, 0))
        if snapshot.wall_s > wall_s:
            rate_hz = (edge.sent - sent) / (snapshot.wall_s - wall_s)
            drawing.append(Entry.of(f"rates/{entity}", rr.Scalars(rate_hz)))
        previous[edge.name] = snapshot.wall_s, edge.sent
        drawing.append(Entry.of(f"queues/{entity}", rr.Scalars(edge.depth)))
        if edge.num_lost:
            drawing.append(Entry.of(f"losses/{entity}", rr.Scalars(edge.num_lost)))
    for operator in snapshot.operators:
        drawing.append(Entry.of(f"load/{operator.name}", rr.Scalars(operator.busy_fraction * 100)))
        if not math.isnan(operator.p50_s):
            drawing.append(Entry.of(f"call_ms/{operator.name}", rr.Scalars(operator.p50_s * 1e3)))
    return [*drawing, _labels(snapshot)]


def _styles(snapshot: Snapshot) -> list[Entry]:
    """Return colours of lines from blue to red in the order of the flow: the viewer's own repeat."""
    edges, operators = (
        [_entity(e.name) for e in snapshot.edges],
        [o.name for o in snapshot.operators],
    )
    plots = {
        "rates": edges,
        "queues": edges,
        "losses": edges,
        "load": operators,
        "call_ms": operators,
    }
    return [
        Entry.of(f"{plot}/{name}", rr.SeriesLines(colors=color), is_static=True)
        for plot, names in plots.items()
        for name, color in zip(
            names, ramp_colors(np.linspace(0.1, 0.9, len(names)), 0, 1).tolist(), strict=True
        )
    ]


def _labels(snapshot: Snapshot) -> Entry:
    """Return the labels, and colours from blue (idle) to red (busy all the time)."""
    busy = np.array([operator.busy_fraction for operator in snapshot.operators])
    colors = ramp_colors(busy, -0.1, 1.1)
    has_failed = [operator.state == "failed" for operator in snapshot.operators]
    colors[has_failed] = _FAILED
    labels = [_label(operator, snapshot.edges) for operator in snapshot.operators]
    return Entry.of(GRAPH, rr.GraphNodes.from_fields(labels=labels, colors=colors))


def _label(operator: OperatorSnapshot, edges: Iterable[EdgeSnapshot]) -> str:
    call = "" if math.isnan(operator.p50_s) else f", {operator.p50_s * 1e3:.1f} ms"
    lines = [operator.name, f"{operator.busy_fraction:.0%} busy{call}"]
    read = [edge for edge in edges if f" -> {operator.name}." in edge.name]
    for text, number in (
        ("queue", sum(edge.depth for edge in read)),
        ("lost", sum(edge.num_lost for edge in read)),
    ):
        lines += [f"{text} {number}"] if number else []
    return "\n".join(lines)


def _entity(edge_name: str) -> str:
    """Return a path part that the legend of a plot can show: `odometry.clouds to keyframes`."""
    sender, _, receiver = edge_name.partition(" -> ")
    return rr.escape_entity_path_part(f"{sender} to {receiver}")


def _places(plan: Plan) -> dict[str, tuple[float, float]]:
    """Return where each operator is drawn: a column per step of the flow, rows around the middle."""
    steps: dict[str, int] = {}
    for name in plan.nodes:  # every sender comes before its receivers
        senders = [e.from_node for e in plan.edges if e.to_node == name and not e.is_feedback]
        steps[name] = 1 + max((steps[sender] for sender in senders), default=-1)
    columns: dict[int, list[str]] = {}
    for name, step in steps.items():
        columns.setdefault(step, []).append(name)
    return {
        name: (step * _COLUMN, (row - (len(names) - 1) / 2) * _ROW)
        for step, names in columns.items()
        for row, name in enumerate(names)
    }
