"""Running a plan: one task per operator, channels between them, and a report at the end.

Nothing here depends on timing: a channel that blocks makes the graph a Kahn process network (Kahn,
The Semantics of a Simple Language for Parallel Programming, 1974), whose results are the same under
any schedule, number of workers and rate.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import anyio

from mapstream.graph.links import Link, edges_with_epochs
from mapstream.graph.metrics import Meter, Snapshot
from mapstream.graph.observed import ObservedSender, Tap, Taps
from mapstream.graph.pace import clock_of
from mapstream.graph.plan import Edge, Node, Plan
from mapstream.graph.remote import RemoteStage
from mapstream.graph.report import RunReport, report_of
from mapstream.graph.spec import OnErrorSpec
from mapstream.graph.stage import Ends, Stage
from mapstream.graph.stop import Stop
from mapstream.graph.watch import Watch
from mapstream.operators.operator import Context
from mapstream.streams.channel import Channel, Receiver, Sender
from mapstream.streams.clock import Clock
from mapstream.streams.errors import OperatorError
from mapstream.streams.spool import DiskSpool

_SPOOL_BYTES = 2**31  # on disk, per edge with the policy `spool`
_log = logging.getLogger(__name__)


async def run_graph(
    plan: Plan,
    *,
    clock: Clock | None = None,
    taps: Sequence[Tap] = (),
    on_progress: Callable[[Snapshot], None] | None = None,
    progress_period_s: float = 0.2,
    stop: Stop | None = None,
) -> RunReport:
    """Run a plan until its sources end or `stop` asks for it; errors of operators are in the report.

    Args:
        plan: What to run.
        clock: Event time; as the plan's profile says if None.
        taps: Called with each message that is sent, on the event loop: they must not wait.
        on_progress: Called with a snapshot every `progress_period_s`, and with the last one.
        progress_period_s: Wall time between two snapshots.
        stop: A request makes the sources end; what is under way is finished and saved. The second
            request cancels everything.
    """
    run = _Run(plan, clock, taps, stop or Stop())
    async with anyio.create_task_group() as background:
        background.start_soon(run.watch.run)
        background.start_soon(run.obey)
        if on_progress is not None:
            background.start_soon(run.tell, on_progress, progress_period_s)
        with run.scope:
            async with anyio.create_task_group() as tasks:
                for stage in run.stages.values():
                    tasks.start_soon(run.run_stage, stage)
        background.cancel_scope.cancel()
    report = run.report()
    if on_progress is not None:
        on_progress(report.final)
    return report


def policy_of(node: Node, plan: Plan) -> OnErrorSpec:
    """Return what happens when an operator raises: sensors drop out and come back, replays are exact."""
    if node.on_error is not None:
        return node.on_error
    is_live = plan.profile.clock.from_ == "wall"
    return OnErrorSpec(do="restart" if is_live and node.is_source else "stop")


def _channel(edge: Edge) -> Channel[Any]:
    spool = DiskSpool(_SPOOL_BYTES) if edge.limits.policy == "spool" else None
    return Channel(edge.name, edge.limits, spool)


class _Run:
    """A plan with everything opened."""

    def __init__(self, plan: Plan, clock: Clock | None, taps: Sequence[Tap], stop: Stop) -> None:
        self._plan = plan
        self._stop = stop
        self._taps = Taps(taps)
        self.scope = anyio.CancelScope()
        self._links = [Link(edge, _channel(edge)) for edge in plan.edges]
        self._marked = edges_with_epochs(plan)
        self.stages: dict[str, Stage] = {}
        self._clock = clock or clock_of(plan.profile.clock, self.stages, self._links)
        self.stages |= {name: self._stage(node) for name, node in plan.nodes.items()}
        self.watch = Watch(self.stages, self._links, self._on_deadlock)
        self._meter = Meter(list(self.stages.values()), self._links)

    def _stage(self, node: Node) -> Stage:
        spans_epochs = node.signature.operator_type.spans_epochs
        inputs = [link for link in self._links if link.edge.to_node == node.name]
        marked = [] if spans_epochs else [i.edge for i in inputs if i.edge in self._marked]
        reads_on = spans_epochs or node.placement == "process"  # there the process sees the epochs
        receivers = {i.edge.to_port: Receiver(i.channel, spans_epochs=reads_on) for i in inputs}
        senders = {port: self._sender(node.name, port) for port in node.signature.outputs}
        kind = RemoteStage if node.placement == "process" else Stage
        return kind(
            node,
            Ends(
                receivers=receivers,
                senders=senders,
                marked=tuple(e.to_port for e in marked if not e.is_feedback),
                marked_feedback=tuple(e.to_port for e in marked if e.is_feedback),
            ),
            Context(
                name=node.name,
                clock=self._clock,
                placement=node.placement,
                workers=node.workers,
                limiter=anyio.CapacityLimiter(node.workers) if node.placement == "thread" else None,
            ),
            policy=policy_of(node, self._plan),
            on_failure=self._on_failure,
        )

    def _sender(self, node: str, port: str) -> Sender[Any]:
        links = [i for i in self._links if (i.edge.from_node, i.edge.from_port) == (node, port)]
        if self._taps or any(link.edge.is_unchecked for link in links):
            return ObservedSender(links, self._taps)
        return Sender([link.channel for link in links])

    async def run_stage(self, stage: Stage) -> None:
        await stage.run()
        readers = [s for s in self.stages.values() if not s.node.is_source]
        if readers and all(s.is_over for s in readers):
            self._stop_sources()  # nobody reads them any more

    async def obey(self) -> None:
        """Act on requests to stop."""
        await self._stop.wait_first()
        self._stop_sources()
        await self._stop.wait_second()
        self.scope.cancel()

    async def tell(self, on_progress: Callable[[Snapshot], None], period_s: float) -> None:
        while True:
            await anyio.sleep(period_s)
            on_progress(self._meter.snapshot(self._clock))

    def _stop_sources(self) -> None:
        for stage in self.stages.values():
            if stage.node.is_source:
                stage.stop()

    def _on_failure(self, error: OperatorError) -> None:
        """Let the sources end, so that the other operators finish and save what there is."""
        _log.error("%s", error)
        self._stop_sources()

    def _on_deadlock(self, error: OperatorError, stuck: list[Stage]) -> None:
        stuck[0].fail(error)
        for stage in stuck[1:]:
            stage.stop()

    def report(self) -> RunReport:
        return report_of(
            self._plan.name,
            list(self.stages.values()),
            self._meter.snapshot(self._clock),
            was_stopped=self._stop.is_requested,
            was_cut=self.scope.cancelled_caught,
            viewer_errors=self._taps.errors,
        )
