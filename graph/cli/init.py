"""`mapstream init`: a first graph for a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.output import say_aside
from mapstream.graph.propose import propose_graph
from mapstream.recordings.recording import open_recording


def init(
    recording: Annotated[Path, typer.Argument(help="The recording to map.")],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="The graph file; printed without.")
    ] = None,
) -> None:
    """Propose a graph from the topics of a recording: LiDAR, IMU, cameras, odometry."""
    with open_recording(recording) as opened:
        text = propose_graph(opened)
    if out is None:
        typer.echo(text, nl=False)
        return
    if out.exists():
        raise typer.BadParameter(f"{out} is there already", param_hint="--out")
    out.write_text(text, encoding="utf-8")
    say_aside(f"wrote {out}; `mapstream check {out} {recording}`, then `mapstream run {out}`")
