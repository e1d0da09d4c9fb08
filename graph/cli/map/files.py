"""Maps to and from files of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.map.look import print_statistics
from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.maps.export import KNOWN, ExportConfig, export_map
from mapstream.operators.maps.import_ import IMPORTERS, import_map
from mapstream.operators.maps.trajectory_map import ImportConfig
from mapstream.recordings.maps import load_map, require_valid, save_map
from mapstream.recordings.maps.combine import with_journal_entry
from mapstream.recordings.maps.store import MANIFEST
from mapstream.streams.errors import ConfigError


def export_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help=f"The file: {KNOWN}.")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write the map as a trajectory, pose graph, point cloud, recording or tables, by the file's suffix."""
    folder: Path = context.obj
    report = export_map(load_map(folder), folder, file, config_from(ExportConfig, set_))
    if json:
        say_json(report)
        return
    content = ", ".join(f"{count} {what}" for what, count in report.written.items())
    for path in report.files if file.suffix else (file,):
        say(f"wrote {in_place(path)}: {content}")
    for what, count in report.left_out.items():
        say(f"left out: {what} ({count}), which {file.suffix} has no place for")


def import_(
    context: typer.Context,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE...",
            help=f"Files, their suffix tells the format; or FORMAT:PATH with {', '.join(IMPORTERS)}.",
        ),
    ],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Make the map from pose graphs or trajectories; the folder must not hold a map yet."""
    folder: Path = context.obj
    if (folder / MANIFEST).exists():
        raise ConfigError(f"{folder}: there is a map already; choose another folder")
    map_ = import_map(sources, config_from(ImportConfig, set_))
    names = [Path(source).name for source in sources]
    save_map(require_valid(with_journal_entry(map_, "import", files=names)), folder)
    print_statistics(folder, json=json)
