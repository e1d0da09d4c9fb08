"""How much a channel holds, what happens when that is too little, and what it counts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

Policy = Literal["block", "drop_oldest", "drop_newest", "latest", "spool", "error"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How much a channel holds, and what happens to the message that is too many."""

    policy: Policy = "block"
    capacity: int = 8  # messages; `latest` holds one whatever this says
    max_bytes: int | None = None  # one message is held however large it is
    max_age_ns: int | None = None  # older messages are dropped when they are taken, by arrival
    lateness_ns: int = 0  # how far behind the newest stamp a message may still come

    def __post_init__(self) -> None:
        if self.capacity < 1:
            raise ValueError(f"a channel holds at least one message, not {self.capacity}")


@dataclass(slots=True)
class ChannelStats:
    """What passed through a channel so far."""

    sent: int = 0
    received: int = 0
    dropped: Counter[str] = field(default_factory=Counter)  # by reason: full, age, unread
    late: int = 0  # messages behind the bound: delivered, but joins drop them
    high_water: int = 0
    grown: int = 0
    blocked_ns: int = 0  # time that senders waited for room


@dataclass(frozen=True, slots=True)
class Arrival:
    """What the channel knows of the message that was taken last."""

    sequence: int
    arrived_ns: int  # monotonic clock
    epoch: int
    bound_ns: int  # of the channel once it was queued; a message with an older stamp was late


# a message or the mark of an epoch, sequence, arrival on the monotonic clock, stamp, bound from there on
Entry = tuple[Any, int, int, int, int]


class Overflow(Protocol):
    """Where a `spool` channel keeps what it cannot hold, first in, first out."""

    def __len__(self) -> int: ...
    def put(self, entry: Entry, *, even_if_full: bool = False) -> bool:
        """Keep one entry; False if there is no room here either."""
        ...

    def get(self) -> Entry: ...
    def clear(self) -> None: ...
