"""What a synthetic world yields: messages with topics, in the order in which they became known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mapstream.streams.messages.sensors import Message
from mapstream.streams.rig import Rig


@dataclass(frozen=True, slots=True)
class Record:
    """A message, its topic, and when it became known."""

    log_ns: int
    topic: str
    message: Message


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """A recording that is made while `records` is read, once."""

    start_ns: int
    end_ns: int
    records: Iterator[Record]  # log times do not decrease
    rig: Rig | None = None  # what the recording says of its sensors
