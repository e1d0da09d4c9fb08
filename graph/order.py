"""What a run orders from a process of its own, and what it gets back when the operator is done."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from mapstream.graph.plan import Node
from mapstream.graph.spec import OnErrorSpec
from mapstream.graph.stage import State
from mapstream.operators.operator import Activity

NUM_FRAMES = struct.Struct("<Q")


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What the parent wants to have run."""

    node: Node
    policy: OnErrorSpec
    inputs: tuple[str, ...]  # connected ones; their frames carry the position here
    outputs: tuple[str, ...]  # those that somebody reads
    marked: tuple[str, ...]
    marked_feedback: tuple[str, ...]
    has_wall_clock: bool
    log_level: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How it went."""

    state: State
    errors: tuple[str, ...]
    trace: str  # of the last error
    activity: Activity
