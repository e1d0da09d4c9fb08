"""Keeping a network of blocking channels alive: grow what is full, or say why nothing can go on.

In a Kahn process network with bounded channels, an operator may wait for room in a channel whose
receiver waits for something else. Parks (Bounded Scheduling of Process Networks, 1995, section 4.2):
when that stops everything, enlarge the smallest full channel. Geilen and Basten (Requirements on the
Execution of Kahn Process Networks, 2003) add that a part of the network may be stuck while the rest
runs, so this looks for sets of operators that wait only for each other. Growing changes no result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import anyio

from mapstream.graph.links import Link
from mapstream.graph.stage import Stage
from mapstream.streams.channel import Channel
from mapstream.streams.errors import OperatorError
from mapstream.streams.sizes import nbytes

PERIOD_S = 0.02
_PATIENCE = 25  # checks that find the same deadlock before it is one
_MAX_QUEUED = 2**16  # messages; a join that needs more will never be satisfied
_MAX_QUEUED_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class _Wait:
    """An operator waits for another: for its message, or for room in what it reads."""

    other: str
    link: Link
    for_room: bool

    def __str__(self) -> str:
        what = "room in" if self.for_room else "a message of"
        return f"{what} {self.link.edge.name} ({len(self.link.channel)} queued)"


class Watch:
    """Looks at the stages and channels of a run, again and again."""

    def __init__(
        self,
        stages: Mapping[str, Stage],
        links: Sequence[Link],
        on_deadlock: Callable[[OperatorError, list[Stage]], None],
    ) -> None:
        self._stages = stages
        self._links = links
        self._on_deadlock = on_deadlock
        self._suspects: set[str] = set()
        self._num_sightings = 0

    async def run(self) -> None:
        while True:
            await anyio.sleep(PERIOD_S)
            self.check()

    def check(self) -> None:
        """Grow one channel where operators wait for each other; report those whom no room can help."""
        waits = {
            name: list(self._waits_of(name))
            for name, stage in self._stages.items()
            if stage.state == "running" and stage.is_at_rest
        }
        stuck = _waiting_for_each_other(waits)
        dead = _waiting_for_each_other(
            {name: waits[name] for name in stuck if not any(w.for_room for w in waits[name])}
        )
        full = [w.link for name in stuck for w in waits[name] if w.for_room and w.other not in dead]
        full = [link for link in full if _may_grow(link.channel)]
        if full:
            smallest = min(full, key=lambda link: (link.channel.capacity, link.edge.name)).channel
            smallest.grow(2 * smallest.capacity)
        elif stuck and not dead:
            dead = stuck  # grown to the limit, in vain
        self._num_sightings = self._num_sightings + 1 if dead and dead == self._suspects else 0
        self._suspects = dead
        if self._num_sightings == _PATIENCE:
            self._on_deadlock(_explain(dead, waits), [self._stages[name] for name in sorted(dead)])

    def _waits_of(self, name: str) -> Iterator[_Wait]:
        for link in self._links:
            edge, channel = link.edge, link.channel
            if edge.to_node == name and channel.is_receiver_waiting and not channel.is_closed:
                yield _Wait(edge.from_node, link, for_room=False)
            if edge.from_node == name and channel.is_sender_waiting:
                yield _Wait(edge.to_node, link, for_room=True)


def _may_grow(channel: Channel[Any]) -> bool:
    queued = len(channel.items)
    return queued < _MAX_QUEUED and sum(nbytes(e[0]) for e in channel.items) < _MAX_QUEUED_BYTES


def _waiting_for_each_other(waits: Mapping[str, Iterable[_Wait]]) -> set[str]:
    """Return the operators all of whose waits are for one another."""
    stuck = {name for name, found in waits.items() if found}
    while True:
        free = {name for name in stuck if any(wait.other not in stuck for wait in waits[name])}
        if not free:
            return stuck
        stuck -= free


def _explain(dead: set[str], waits: Mapping[str, Sequence[_Wait]]) -> OperatorError:
    """Follow who waits for whom until an operator comes again."""
    name = min(dead)
    steps: dict[str, str] = {}
    while name not in steps:
        wait = waits[name][0]
        steps[name] = f"{name} waits for {wait}"
        name = wait.other
    cycle = list(steps)[list(steps).index(name) :]
    return OperatorError(
        f"deadlock: {'; '.join(steps[n] for n in cycle)}. An operator in a cycle must send something "
        "before it reads its own results back, and a join needs messages or bounds on all its inputs"
    )
