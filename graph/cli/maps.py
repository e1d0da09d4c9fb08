"""`mapstream map DIR COMMAND`: the offline tools for maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    complain,
    in_place,
    plain,
    say,
    say_json,
    say_table,
)
from mapstream.operators.maps.export import EXPORTERS, ExportConfig, export_map
from mapstream.operators.maps.import_ import IMPORTERS, ImportConfig, import_map
from mapstream.operators.maps.statistics import map_statistics
from mapstream.recordings.maps import check_map, load_map, require_valid, save_map
from mapstream.recordings.maps.combine import with_journal_entry
from mapstream.recordings.maps.store import MANIFEST
from mapstream.streams.errors import ConfigError

app = typer.Typer(
    help="Work on a map: `mapstream map DIR COMMAND`.", no_args_is_help=True, rich_markup_mode=None
)


@app.callback()
def _folder(context: typer.Context, folder: Annotated[Path, typer.Argument(metavar="DIR")]) -> None:
    """Work on the map in a folder."""
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
        count = f"{len(violations)} violations" if violations else "no violations"
        say(f"{in_place(folder)}: {count}")
    if violations:
        raise typer.Exit(ExitCode.FAILED)


@app.command()
def stats(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Tell what is in the map: missions, lengths, edges, landmarks, files."""
    print_statistics(context.obj, json=json)


def print_statistics(folder: Path, *, json: bool) -> None:
    """Print what is in a map."""
    found = map_statistics(load_map(folder))
    if json:
        say_json({"path": folder, **plain(found)})
        return
    length = f"{found.length_m:.1f} m"
    say(f"{in_place(folder)}: {len(found.missions)} missions, {length}, digest {found.digest[:16]}")
    say_table(
        ("mission", "name", "vertices", "duration s", "length m", "anchored"),
        [
            (
                m.mission_id,
                m.name,
                m.num_vertices,
                m.duration_s,
                m.length_m,
                "yes" if m.is_anchored else "no",
            )
            for m in found.missions
        ],
    )
    say_table(
        ("edges", "count", "between missions", "switched off"),
        [(e.kind, e.count, e.num_between_missions, e.num_switched_off) for e in found.edges],
    )
    for what, counts in (("landmarks", found.landmarks), ("files", found.resources)):
        if counts:
            say_table((what, "count"), list(counts.items()))


@app.command()
def view(
    context: typer.Context,
    *,
    rerun: Annotated[str, typer.Option(help="spawn, connect[=URL] or save=FILE.")] = "spawn",
) -> None:
    """Show the map in Rerun: trajectories, loops by their switches, the cloud of all keyframes."""
    from mapstream.graph.tap_map import view_map  # noqa: PLC0415  # rerun takes its time
    from mapstream.graph.tap_sinks import SinkSpec  # noqa: PLC0415

    folder: Path = context.obj
    for note in view_map(load_map(folder), folder, SinkSpec.parse(rerun).open()):
        complain(note)


@app.command(name="export")
def export_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The file: " + ", ".join(EXPORTERS) + ".")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Write the map as a trajectory, a pose graph, a point cloud or a recording, by the file's suffix."""
    folder: Path = context.obj
    report = export_map(load_map(folder), folder, file, config_from(ExportConfig, set_))
    if json:
        say_json(report)
        return
    content = ", ".join(f"{count} {what}" for what, count in report.written.items())
    for path in report.files:
        say(f"wrote {in_place(path)}: {content}")
    for kind, count in report.left_out.items():
        say(f"left out: {count} edges of kind {kind}, which {file.suffix} has no place for")


@app.command(name="import")
def import_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The file: " + ", ".join(IMPORTERS) + ".")],
    *,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Make the map from a pose graph or a trajectory; the folder must not hold a map yet."""
    folder: Path = context.obj
    if (folder / MANIFEST).exists():
        raise ConfigError(f"{folder}: there is a map already; choose another folder")
    map_ = import_map(file, config_from(ImportConfig, set_))
    save_map(require_valid(with_journal_entry(map_, "import", file=file.name)), folder)
    print_statistics(folder, json=json)


@app.command()
def optimize(context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False) -> None:
    """Find the most likely poses of the whole map, and switch false loop closures off."""
    from mapstream.operators.estimation.batch import (  # noqa: PLC0415  # gtsam takes its time
        OptimizeConfig,
        optimize_map,
    )

    folder: Path = context.obj
    config = config_from(OptimizeConfig, set_)
    optimised, report = optimize_map(require_valid(load_map(folder), folder), config)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    save_map(with_journal_entry(optimised, "optimize", **settings), folder)
    if json:
        say_json(report)
        return
    error = f"error {report.error_before:.6g} -> {report.error_after:.6g}"
    steps = f"{report.iterations} iterations, {report.seconds:.1f} s"
    say(f"{in_place(folder)}: {report.num_vertices} vertices, {error}, {steps}")
    edges = ", ".join(f"{count} {kind}" for kind, count in report.num_edges.items())
    say(f"edges: {edges}; {len(report.switched_off)} switched off")
    for kind, count in report.ignored.items():
        say(f"ignored: {count} edges of kind {kind}")
