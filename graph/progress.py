"""How far a run is, for somebody who watches: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from mapstream.graph.metrics import Snapshot

_LINE_PERIOD_S = 5.0  # between two lines where there is no terminal


class ProgressBar:
    """Shows snapshots; a context manager, to be called with each one."""

    def __init__(self, console: Console | None = None) -> None:
        from rich.console import Console  # noqa: PLC0415  # not for every verb

        self._console = console or Console(stderr=True, highlight=False)
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._next_line_s = _LINE_PERIOD_S

    def __enter__(self) -> Self:
        from rich.progress import (  # noqa: PLC0415  # not for every verb
            BarColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeRemainingColumn,
        )

        if self._console.is_terminal:
            self._bar = Progress(
                BarColumn(),
                TaskProgressColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.description}"),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task("starting", total=None)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, snapshot: Snapshot) -> None:
        if self._bar is not None and self._task is not None:
            done = fraction_done(snapshot)
            self._bar.update(
                self._task,
                total=None if done is None else 1.0,
                completed=done or 0.0,
                description=describe(snapshot),
            )
        elif snapshot.wall_s >= self._next_line_s:
            self._next_line_s = snapshot.wall_s + _LINE_PERIOD_S
            done = fraction_done(snapshot)
            percent = "" if done is None else f"{100 * done:.0f} %, "
            self._console.print(f"{snapshot.wall_s:.0f} s: {percent}{describe(snapshot)}")


def fraction_done(snapshot: Snapshot) -> float | None:
    """Return how much of the recording has been played; None where no source knows."""
    if snapshot.position_ns is None or snapshot.span_ns is None:
        return None
    start_ns, end_ns = snapshot.span_ns
    return min(1.0, (snapshot.position_ns - start_ns) / max(1, end_ns - start_ns))


def describe(snapshot: Snapshot) -> str:
    """Return speed, the operator that limits and what was dropped, as far as there is any."""
    parts = []
    if not math.isnan(snapshot.speed):
        parts.append(f"{snapshot.speed:.1f} x real time")
    if snapshot.auto_rate is not None:
        parts.append(f"automatic rate {snapshot.auto_rate:.1f} x")
    if snapshot.limiting is not None:
        busiest = next(o for o in snapshot.operators if o.name == snapshot.limiting)
        parts.append(f"limited by {busiest.name} ({100 * busiest.busy_fraction:.0f} % busy)")
    if snapshot.num_lost:
        parts.append(f"{snapshot.num_lost} dropped")
    return ", ".join(parts) or "running"
