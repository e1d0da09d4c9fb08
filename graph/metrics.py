"""What a run does right now, and did in all: per edge, per operator, and which operator limits."""

from __future__ import annotations

import math
import os
import resource
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic_ns
from typing import Any

from mapstream.graph.links import Link
from mapstream.graph.stage import Stage, State
from mapstream.streams.clock import Clock, ReplayClock

_UNREAD = "unread"  # what an operator that returned early left behind: its choice, no loss


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeSnapshot:
    """One channel."""

    name: str
    sent: int
    received: int
    depth: int
    capacity: int
    high_water: int
    dropped: dict[str, int]  # by reason
    late: int
    grown: int  # how often the runtime raised the capacity
    blocked_s: float  # time that the sender waited for room
    age_s: float  # how long the message at the head has waited

    @property
    def lost(self) -> dict[str, int]:
        """Messages that were dropped against the receiver's will, by reason."""
        return {reason: n for reason, n in self.dropped.items() if reason != _UNREAD}

    @property
    def num_lost(self) -> int:
        return sum(self.lost.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorSnapshot:
    """One operator. Times of calls are those of `offload`; nan where there were none."""

    name: str
    use: str
    placement: str
    state: State
    num_calls: int
    p50_s: float
    p95_s: float
    p99_s: float
    loop_s: float  # on the event loop of its process
    busy_s: float  # at work, on the loop or beside it
    busy_fraction: float  # of the time since the start and of its workers
    cpu_s: float
    rss_bytes: int | None  # of its own process
    num_errors: int
    warnings: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """The whole run at one moment."""

    wall_s: float  # since the start
    cpu_s: float  # of all processes of the run
    rss_bytes: int  # of this process
    now_ns: int  # event time
    auto_rate: float | None  # that the clock achieved, times real time; None if it does not adapt
    position_ns: int | None  # of the source that is behind: log time
    span_ns: tuple[int, int] | None  # of all sources
    operators: tuple[OperatorSnapshot, ...]
    edges: tuple[EdgeSnapshot, ...]

    @property
    def limiting(self) -> str | None:
        """The operator that is busiest: the run cannot go faster than it does."""
        busiest = max(self.operators, key=lambda o: o.busy_fraction, default=None)
        return busiest.name if busiest and busiest.busy_fraction > 0 else None

    @property
    def num_lost(self) -> int:
        return sum(edge.num_lost for edge in self.edges)

    @property
    def speed(self) -> float:
        """Recorded seconds per second of the run; nan where no source tells its position."""
        if self.position_ns is None or self.span_ns is None or self.wall_s == 0:
            return math.nan
        return (self.position_ns - self.span_ns[0]) / 1e9 / self.wall_s

    def to_json(self) -> dict[str, Any]:
        """Return the snapshot as plain values, for one line of JSON; nan becomes None."""
        values: dict[str, Any] = asdict(self) | {"limiting": self.limiting, "speed": self.speed}
        return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:  # noqa: ANN401  # of a JSON document
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Meter:
    """Takes snapshots of a run that is under way."""

    def __init__(self, stages: Sequence[Stage], links: Sequence[Link]) -> None:
        self._stages = stages
        self._links = links
        self._spanning = {
            s.node.name for s in stages if s.node.signature.operator_type.spans_epochs
        }
        self._started_s = time.perf_counter()
        self._started_cpu_s = time.process_time()

    def snapshot(self, clock: Clock) -> Snapshot:
        wall_s = time.perf_counter() - self._started_s
        operators = tuple(_operator(stage, wall_s) for stage in self._stages)
        elsewhere_s = sum(o.cpu_s for o in operators if o.placement == "process")
        positions = [
            s.activity.position_ns for s in self._stages if s.activity.position_ns is not None
        ]
        spans = [s.activity.span_ns for s in self._stages if s.activity.span_ns is not None]
        return Snapshot(
            wall_s=wall_s,
            cpu_s=time.process_time() - self._started_cpu_s + elsewhere_s,
            rss_bytes=resident_bytes(),
            now_ns=clock.now_ns(),
            auto_rate=_auto_rate(clock),
            position_ns=min(positions, default=None),
            span_ns=_hull(spans),
            operators=operators,
            edges=tuple(_edge(link, link.edge.from_node in self._spanning) for link in self._links),
        )


def _auto_rate(clock: Clock) -> float | None:
    if isinstance(clock, ReplayClock) and clock.is_adapting:
        return clock.achieved_rate
    return None


def _hull(spans: Iterable[tuple[int, int]]) -> tuple[int, int] | None:
    spans = list(spans)
    return (min(s for s, _ in spans), max(e for _, e in spans)) if spans else None


def _operator(stage: Stage, wall_s: float) -> OperatorSnapshot:
    node, activity = stage.node, stage.activity
    calls = activity.calls
    loop_s, call_s = activity.loop_ns / 1e9, calls.total_ns / 1e9
    busy_s = (
        loop_s + call_s if node.placement == "thread" else loop_s
    )  # else the loop made the calls
    workers = node.workers if node.placement == "thread" else 1
    return OperatorSnapshot(
        name=node.name,
        use=node.use,
        placement=node.placement,
        state=stage.state,
        num_calls=calls.count,
        p50_s=calls.quantile_ns(0.50) / 1e9,
        p95_s=calls.quantile_ns(0.95) / 1e9,
        p99_s=calls.quantile_ns(0.99) / 1e9,
        loop_s=loop_s,
        busy_s=busy_s,
        busy_fraction=busy_s / wall_s / workers if wall_s else 0.0,
        cpu_s=activity.cpu_ns / 1e9 + (0.0 if node.placement == "process" else loop_s),
        rss_bytes=activity.rss_bytes,
        num_errors=len(stage.errors),
        warnings=dict(activity.warnings),
    )


def _edge(link: Link, spans_epochs: bool) -> EdgeSnapshot:  # noqa: FBT001
    """Return one edge; a sender that spans epochs may go back in time, and nothing is late then."""
    channel, stats = link.channel, link.channel.stats
    return EdgeSnapshot(
        name=link.edge.name,
        sent=stats.sent,
        received=stats.received,
        depth=len(channel),
        capacity=channel.capacity,
        high_water=stats.high_water,
        dropped={reason: count for reason, count in stats.dropped.items() if count},
        late=0 if spans_epochs else stats.late,
        grown=stats.grown,
        blocked_s=stats.blocked_ns / 1e9,
        age_s=(monotonic_ns() - channel.items[0][2]) / 1e9 if channel.items else 0.0,
    )


def resident_bytes() -> int:
    """Return how much memory this process holds now; its peak where the system does not tell."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
