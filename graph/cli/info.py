"""`mapstream info`: what is in a recording or a map."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from mapstream.graph.cli.output import ExitCode, JsonFlag, complain, say, say_json, say_table
from mapstream.recordings.decoding import message_type_of
from mapstream.recordings.recording import Recording, Topic, open_recording

_MANIFEST = "manifest.json"


def info(
    path: Annotated[Path, typer.Argument(help="A recording, or the folder of a map.")],
    *,
    json: JsonFlag = False,
) -> None:
    """Tell what is in a recording (topics, rates, what can be decoded) or in a map (missions, tables)."""
    if (path / _MANIFEST).is_file():
        from mapstream.graph.cli.map.look import print_statistics  # noqa: PLC0415  # pyarrow takes its time

        print_statistics(path, json=json)
        return
    with open_recording(path) as recording:
        found = describe(recording)
    if json:
        say_json(found)
    else:
        span = f"{found['duration_s']:.1f} s from {found['start']}"
        say(f"{path}: {found['num_messages']} messages, {span}, {found['num_bytes'] / 1e6:.1f} MB")
        columns = ("topic", "count", "rate_hz", "schema", "encoding", "read_as")
        say_table(columns, [[topic[c] for c in columns] for topic in found["topics"]])
    for loss in found["losses"]:
        complain(f"lost at byte {loss.offset}: {loss.reason}")
    if found["losses"]:
        raise typer.Exit(ExitCode.LOSSY)


def describe(recording: Recording) -> dict[str, Any]:
    """Return the contents of a recording as plain values."""
    topics = recording.topics.values()
    path = recording.path
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
    start = datetime.fromtimestamp(recording.start_ns / 1e9, tz=UTC)
    return {
        "path": path,
        "num_bytes": sum(file.stat().st_size for file in files),
        "num_messages": sum(topic.count for topic in topics),
        "start": start.isoformat(sep=" ", timespec="seconds"),
        "start_ns": recording.start_ns,
        "end_ns": recording.end_ns,
        "duration_s": (recording.end_ns - recording.start_ns) / 1e9,
        "topics": [
            {
                "topic": topic.name,
                "count": topic.count,
                "rate_hz": round(topic.frequency, 2),
                "schema": topic.schema_name or "(none)",
                "encoding": topic.message_encoding,
                "read_as": _read_as(topic),
            }
            for topic in sorted(topics, key=lambda t: t.name)
        ],
        "losses": recording.losses,
    }


def _read_as(topic: Topic) -> str:
    kind = message_type_of(topic.channel)
    return kind.__name__ if kind else "not decoded"
