"""How fast a run goes: the clock that its profile asks for, and how full the queues are under `auto`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mapstream.graph.links import Link
from mapstream.graph.spec import ClockSpec
from mapstream.graph.stage import Stage
from mapstream.streams.clock import AutoRate, Clock, ReplayClock, WallClock


def clock_of(spec: ClockSpec, stages: Mapping[str, Stage], links: Sequence[Link]) -> Clock:
    """Return the clock of a run; with the rate `auto` it looks at the stages and links as it goes."""
    if spec.from_ == "wall":
        return WallClock()
    if spec.rate == "auto":
        return ReplayClock(auto=AutoRate(fill=lambda: fullest(stages, links)))
    return ReplayClock(None if spec.rate == "max" else spec.rate)


def fullest(stages: Mapping[str, Stage], links: Sequence[Link]) -> float:
    """Return how full the fullest queue is whose reader is behind.

    A reader that waits, for another input or for room downstream, is not behind: a join could never go
    on if the sources waited for it. Nor does a queue count that loses by its policy whatever the rate
    (`latest`), or that has the disk behind it (`spool`).
    """
    fills = [
        (link.channel.fill, link.edge.to_node)
        for link in links
        if link.channel.items and link.edge.limits.policy not in ("latest", "spool")
    ]
    for fill, reader in sorted(fills, reverse=True):
        if not (stages[reader].is_at_rest and _waits(reader, links)):
            return fill
    return 0.0


def _waits(name: str, links: Sequence[Link]) -> bool:
    return any(
        (link.edge.to_node == name and link.channel.is_receiver_waiting)
        or (link.edge.from_node == name and link.channel.is_sender_waiting)
        for link in links
    )
