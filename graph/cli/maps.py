"""`mapstream map DIR COMMAND`: the offline tools for maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    complain,
    say,
    say_json,
    say_table,
)
from mapstream.recordings.maps import Map, check_map, load_map

app = typer.Typer(
    help="Work on a map: `mapstream map DIR COMMAND`.", no_args_is_help=True, rich_markup_mode=None
)


@app.callback()
def _folder(context: typer.Context, folder: Annotated[Path, typer.Argument(metavar="DIR")]) -> None:
    """Work on the map in a folder: import, export, stats, check, optimize."""
    context.obj = folder


@app.command()
def check(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Check the map against every rule of the format; exits 1 if one is broken."""
    folder: Path = context.obj
    violations = check_map(load_map(folder), folder)
    if json:
        say_json({"path": folder, "violations": violations})
    else:
        for violation in violations:
            complain(str(violation))
        say(f"{folder}: " + (f"{len(violations)} violations" if violations else "no violations"))
    if violations:
        raise typer.Exit(ExitCode.FAILED)


@app.command()
def stats(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Tell what is in the map: missions, lengths, edges, landmarks, files."""
    print_stats(context.obj, json=json)


def print_stats(folder: Path, *, json: bool) -> None:
    """Print what is in a map."""
    found = map_stats(load_map(folder))
    if json:
        say_json({"path": folder, **found})
        return
    say(f"{folder}: {len(found['missions'])} missions, digest {found['digest'][:16]}")
    columns = ("mission", "name", "vertices", "duration_s", "length_m", "is_anchored")
    say_table(columns, [[mission[c] for c in columns] for mission in found["missions"]])
    say_table(("table", "rows"), list(found["rows"].items()))
    if found["edges"]:
        say_table(("edges", "count", "switched_off"), [list(e.values()) for e in found["edges"]])


def map_stats(map_: Map) -> dict[str, Any]:
    """Return the contents of a map in numbers."""
    kinds = sorted(set(map_.edges.kind))
    return {
        "digest": map_.digest(),
        "missions": [_mission(map_, row) for row in range(len(map_.missions))],
        "rows": {name: len(table) for name, table in map_.tables().items()},
        "edges": [
            {
                "kind": kind,
                "count": len(map_.edges_of(kind)),
                "switched_off": int((map_.edges.switch[map_.edges_of(kind)] < 0.5).sum()),
            }
            for kind in kinds
        ],
    }


def _mission(map_: Map, row: int) -> dict[str, Any]:
    rows = map_.vertices_of(row)
    positions = map_.vertices.T_mission_base[rows, :3, 3]
    stamps_ns = map_.vertices.stamp_ns[rows]
    return {
        "mission": map_.mission_id(row),
        "name": map_.missions.name[row],
        "vertices": len(rows),
        "duration_s": float(np.ptp(stamps_ns) / 1e9) if len(rows) else 0.0,
        "length_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "is_anchored": bool(map_.missions.is_base_frame_known[row]),
    }
