"""Seeing each message as it is sent: for viewers, and for edges whose type nobody knew before."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Any

from mapstream.graph.links import Link
from mapstream.graph.plan import Edge
from mapstream.streams.channel import Arrival, Sender
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.sensors import Message

_log = logging.getLogger(__name__)

Tap = Callable[[Edge, Any, Arrival], None]


class Taps:
    """The taps of a run; one that raises is taken out, since viewing must not end mapping."""

    def __init__(self, taps: Sequence[Tap]) -> None:
        self._taps = list(taps)
        self.errors: list[str] = []

    def __bool__(self) -> bool:
        return bool(self._taps)

    def show(self, edge: Edge, message: Message, arrival: Arrival) -> None:
        for tap in tuple(self._taps):
            try:
                tap(edge, message, arrival)
            except Exception as error:  # noqa: BLE001  # the border between viewers and the run
                self._taps.remove(tap)
                self.errors.append(f"a viewer failed at {edge.name}, and was taken out: {error!r}")
                _log.exception("a viewer failed at %s, and was taken out", edge.name)


class ObservedSender(Sender[Any]):
    """Shows each message to the taps, and looks at the type of the first one where that is unknown."""

    def __init__(self, links: Sequence[Link], taps: Taps) -> None:
        super().__init__([link.channel for link in links])
        self._links = links
        self._taps = taps
        self._epoch = 0
        self._unchecked = [link.edge for link in links if link.edge.is_unchecked]

    async def send(self, message: Any) -> None:  # noqa: ANN401  # of any channel
        if self._unchecked:
            self._check(message)
        if self._taps:
            for link in self._links:
                channel = link.channel
                arrival = Arrival(channel.stats.sent, monotonic_ns(), self._epoch, channel.bound_ns)
                self._taps.show(link.edge, message, arrival)
        await super().send(message)

    def start_epoch(self) -> None:
        self._epoch += 1
        super().start_epoch()

    def _check(self, message: object) -> None:
        for edge in self._unchecked:
            expected = edge.message_type
            if expected is not Message and not isinstance(message, expected):
                name = getattr(expected, "__name__", str(expected))
                raise ConfigError(
                    f"{edge.name}: expected {name}, got {type(message).__name__}; "
                    f"connect {edge.to_node}.{edge.to_port} to an output of that type"
                )
        self._unchecked = []
