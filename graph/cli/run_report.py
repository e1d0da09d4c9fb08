"""The end of a run, told: how long, what limited it, what was lost."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from mapstream.graph.cli.output import complain, say, say_table
from mapstream.graph.metrics import EdgeSnapshot, Snapshot
from mapstream.graph.report import RunReport

_MAX_WARNINGS = 20


def print_report(report: RunReport) -> None:
    """Print the times of the run and of each operator, the edges where something happened, and why it failed."""
    final = report.final
    say(f"{report.name}: {_outcome(report)} in {final.wall_s:.1f} s{_speed(final)}")
    say(f"processor {final.cpu_s:.1f} s, memory {final.rss_bytes / 1e6:.0f} MB{_limit(final)}")
    columns = ("operator", "runs", "calls", "p50 ms", "p95 ms", "busy %", "cpu s", "errors")
    say_table(
        columns,
        [
            (
                o.name,
                o.placement,
                o.num_calls,
                round(o.p50_s * 1e3, 3),
                round(o.p95_s * 1e3, 3),
                round(100 * o.busy_fraction, 1),
                round(o.cpu_s, 2),
                o.num_errors,
            )
            for o in final.operators
        ],
    )
    for line in _edges(final):
        say(line)
    warnings = [(o.name, text, n) for o in final.operators for text, n in o.warnings.items()]
    for name, text, count in warnings[:_MAX_WARNINGS]:
        say(f"warning: {name}: {text}" + (f" ({count} times)" if count > 1 else ""))
    if len(warnings) > _MAX_WARNINGS:
        say(f"warning: and {len(warnings) - _MAX_WARNINGS} more; --json has all")
    for reason in report.reasons:
        complain(reason)


def report_as_json(report: RunReport) -> dict[str, Any]:
    """Return a report for programs."""
    return {
        "name": report.name,
        "status": report.status,
        "exit_code": report.exit_code,
        "reasons": list(report.reasons),
        "errors": [str(error) for error in report.errors],
        "was_stopped": report.was_stopped,
        **report.final.to_json(),
    }


def _outcome(report: RunReport) -> str:
    words = {"complete": "complete", "failed": "FAILED", "lossy": "finished with loss"}
    return words[report.status] + (", stopped on request," if report.was_stopped else "")


def _speed(final: Snapshot) -> str:
    speed = "" if math.isnan(final.speed) else f", {final.speed:.1f} x real time"
    return speed + ("" if final.auto_rate is None else f", automatic rate {final.auto_rate:.1f} x")


def _limit(final: Snapshot) -> str:
    return f", limited by {final.limiting}" if final.limiting else ""


def _edges(final: Snapshot) -> Iterator[str]:
    for edge in final.edges:
        events = ", ".join(_events(edge))
        if events:
            yield f"{edge.name}: {edge.sent} sent, {events}"


def _events(edge: EdgeSnapshot) -> Iterator[str]:
    yield from (f"{count} dropped ({reason})" for reason, count in edge.lost.items())
    if edge.late:
        yield f"{edge.late} late"
    if edge.grown:
        yield f"grown {edge.grown} times to {edge.capacity}"
