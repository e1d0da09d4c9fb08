"""`mapstream doctor`: what is wrong with a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    complain,
    fraction_bar,
    in_place,
    say,
    say_json,
    say_table,
)
from mapstream.recordings.diagnosis import Diagnosis, diagnose
from mapstream.recordings.recording import open_recording


def doctor(
    recording: Annotated[Path, typer.Argument(help="The recording to examine.")],
    *,
    json: JsonFlag = False,
) -> None:
    """Read a whole recording and tell what is wrong: gaps, clocks, units, rates, axes, damage; exits 3 on loss."""
    with open_recording(recording) as opened, fraction_bar("reading") as show:
        span_ns = max(1, opened.end_ns - opened.start_ns)
        found = diagnose(opened, lambda log_ns: show((log_ns - opened.start_ns) / span_ns))
    if json:
        say_json(found)
    else:
        _tell(found)
    if found.losses:
        raise typer.Exit(ExitCode.LOSSY)


def _tell(found: Diagnosis) -> None:
    say(f"{in_place(found.path)}: {found.duration_s:.1f} s")
    say_table(
        ("topic", "messages", "rate_hz", "stamp - log [s]", "read as", "undecodable"),
        [
            (
                t.topic,
                t.num_read,
                t.rate_hz,
                t.offset_s,
                t.message_type.__name__ if t.message_type else "not decoded",
                t.num_undecodable,
            )
            for t in found.topics
        ],
    )
    for finding in found.findings:
        where = f"{finding.topic}: " if finding.topic else ""
        say(f"{finding.severity}: {where}{finding.text} ({finding.name})")
    for loss in found.losses:
        complain(f"lost at byte {loss.offset}: {loss.reason}")
    if found.is_clean:
        say("nothing wrong")
