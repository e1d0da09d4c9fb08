"""Running a plan from the command line: signals, the viewer, progress, the report."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import anyio

from mapstream.graph.metrics import Snapshot
from mapstream.graph.plan import Plan
from mapstream.graph.progress import ProgressBar
from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.graph.stop import Stop, on_signals
from mapstream.graph.tap import RerunTap
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.graph.trace import TraceFile


def execute(
    plan: Plan, *, rerun: str = "off", trace: Path | None = None, has_progress: bool = True
) -> tuple[RunReport, list[str]]:
    """Run a plan to its end: a viewer if `rerun` names one, a file of snapshots, a bar on a terminal.

    Returns:
        The report, and what the viewer's user should know.

    Raises:
        ConfigError: If the viewer cannot be opened.
        OSError: If the trace cannot be written.
    """
    spec = SinkSpec.parse(rerun)
    tap = None if spec.kind == "off" else RerunTap(plan, spec.open())
    listeners: list[Callable[[Snapshot], None]] = [] if tap is None else [tap.on_progress]
    with ExitStack() as stack:
        if has_progress:
            listeners.append(stack.enter_context(ProgressBar()))
        if trace is not None:
            listeners.append(stack.enter_context(TraceFile(trace)))
        try:
            report = anyio.run(_run, plan, [] if tap is None else [tap], listeners)
        finally:
            if tap is not None:
                tap.close()
    return report, [] if tap is None else tap.notes()


async def _run(
    plan: Plan, taps: list[RerunTap], listeners: list[Callable[[Snapshot], None]]
) -> RunReport:
    def on_progress(snapshot: Snapshot) -> None:
        for listener in listeners:
            listener(snapshot)

    stop = Stop()
    async with on_signals(stop):
        return await run_graph(plan, taps=taps, on_progress=on_progress, stop=stop)
