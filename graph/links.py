"""The edges of a plan, once they are channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mapstream.graph.plan import Edge, Plan
from mapstream.streams.channel import Channel


@dataclass(frozen=True, slots=True)
class Link:
    """An edge of the plan, with the channel that it became."""

    edge: Edge
    channel: Channel[Any]


def edges_with_epochs(plan: Plan) -> list[Edge]:
    """Return the edges in which epochs are marked.

    A source marks its outputs; an operator that starts anew marks its own; one that spans epochs
    reads on, and its outputs know nothing of epochs.
    """
    marking = {node.name for node in plan.nodes.values() if node.is_source}
    while True:
        more = {
            edge.to_node
            for edge in plan.edges
            if edge.from_node in marking
            and not plan.nodes[edge.to_node].signature.operator_type.spans_epochs
        }
        if more <= marking:
            return [edge for edge in plan.edges if edge.from_node in marking]
        marking |= more
