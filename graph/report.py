"""What a run tells when it is over."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from mapstream.graph.metrics import EdgeSnapshot, Snapshot
from mapstream.graph.stage import Stage
from mapstream.streams.errors import OperatorError

Status = Literal["complete", "failed", "lossy"]
_EXIT_CODES: dict[Status, int] = {"complete": 0, "failed": 1, "lossy": 3}


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """How a run went: `lossy` where data was dropped, came too late, or was damaged in a recording."""

    name: str
    status: Status
    reasons: tuple[str, ...]  # why the status is not `complete`
    errors: tuple[OperatorError, ...]  # also those that a policy tolerated
    was_stopped: bool  # by a request, before the sources ended
    final: Snapshot
    warnings: tuple[str, ...] = ()
    written: tuple[str, ...] = ()  # files and folders that the run leaves behind

    @property
    def exit_code(self) -> int:
        return _EXIT_CODES[self.status]


def report_of(
    name: str,
    stages: Sequence[Stage],
    final: Snapshot,
    *,
    was_stopped: bool,
    was_cut: bool,
    viewer_errors: Sequence[str],
) -> RunReport:
    """Judge a run by how its operators and channels ended."""
    failures = [str(stage.errors[-1]) for stage in stages if stage.state == "failed"]
    if was_cut:
        failures.append("cut short by the second request to stop; what was not saved is lost")
    losses = [reason for edge in final.edges for reason in _losses(edge)]
    losses += [reason for stage in stages for reason in _losses_of(stage)]
    status: Status = "failed" if failures else "lossy" if losses else "complete"
    warnings = [
        f"{s.node.name}: {text} ({count} times)"
        for s in stages
        for text, count in s.activity.warnings.items()
    ]
    return RunReport(
        name=name,
        status=status,
        reasons=(*failures, *losses),
        errors=tuple(error for stage in stages for error in stage.errors),
        was_stopped=was_stopped,
        final=final,
        warnings=(*warnings, *viewer_errors),
        written=tuple(path for stage in stages for path in stage.activity.written),
    )


def _losses(edge: EdgeSnapshot) -> Iterator[str]:
    if edge.num_lost:
        reasons = ", ".join(f"{count} {why}" for why, count in sorted(edge.lost.items()))
        yield f"{edge.name}: {edge.num_lost} messages dropped ({reasons})"
    if edge.late:
        yield f"{edge.name}: {edge.late} messages came later than the edge allows"


def _losses_of(stage: Stage) -> Iterator[str]:
    tolerated = len(stage.errors) - (stage.state == "failed")
    if tolerated:
        yield f"{stage.node.name}: {tolerated} errors, and the run went on ({stage.errors[0]})"
    for what, count in sorted(stage.activity.losses.items()):
        yield f"{stage.node.name}: {what}" + (f" ({count} times)" if count > 1 else "")
