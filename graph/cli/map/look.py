"""What is in a map, and whether it keeps the rules: verbs that only look."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
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
from mapstream.operators.maps.cloud_quality import CloudQualityConfig, map_cloud_quality
from mapstream.operators.maps.statistics import map_statistics
from mapstream.recordings.maps import check_map, load_map
from mapstream.recordings.mesh_files import read_mesh
from mapstream.streams.arrays import FloatArray


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


def stats(context: typer.Context, *, json: JsonFlag = False) -> None:
    """Tell what is in the map: missions, lengths, edges, landmarks, files."""
    print_statistics(context.obj, json=json)


def cloud_quality(
    context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False
) -> None:
    """Tell how sharp the cloud of all keyframes is: of two maps of one place, the better one is sharper."""
    folder: Path = context.obj
    found = map_cloud_quality(load_map(folder), folder, config_from(CloudQualityConfig, set_))
    if json:
        say_json({"path": folder, **plain(found)})
        return
    say(
        f"{in_place(folder)}: mean map entropy {found.entropy:.3f}, surfaces {1000 * found.plane_sigma_m:.1f} mm"
    )
    say(f"from {found.num_points} neighbourhoods; {found.num_lonely} points had too few neighbours")


def print_statistics(folder: Path, *, json: bool) -> None:
    """Print what is in a map."""
    found = map_statistics(load_map(folder))
    if json:
        say_json({"path": folder, **plain(found)})
        return
    length = f"{found.length_m:.1f} m"
    say(f"{in_place(folder)}: {len(found.missions)} missions, {length}, digest {found.digest[:16]}")
    say_table(
        ("mission", "name", "vertices", "length m", "duration s", "step s", "longest gap s"),
        [
            (
                m.mission_id,
                m.name,
                m.num_vertices,
                m.length_m,
                m.duration_s,
                m.step_s,
                m.longest_gap_s,
            )
            for m in found.missions
        ],
    )
    say_table(
        ("base frame", "known", "x m", "y m", "z m", "yaw deg"),
        [
            (m.mission_id[:8], "yes" if m.is_anchored else "no", *_place(m.T_map_mission))
            for m in found.missions
        ],
    )
    say_table(
        ("edges", "count", "between missions", "switched off"),
        [(e.kind, e.count, e.num_between_missions, e.num_switched_off) for e in found.edges],
    )
    for what, counts in (
        ("landmarks", found.landmarks),
        ("objects", found.objects),
        ("regions", found.regions),
        ("files", found.resources),
    ):
        if counts:
            say_table((what, "count"), list(counts.items()))
    if found.coobservability.any():
        names = [m.mission_id[:8] for m in found.missions]
        counts_ = found.coobservability.tolist()
        say_table(
            ("landmarks seen by both", *names),
            [(name, *row) for name, row in zip(names, counts_, strict=True)],
        )


def _place(T_map_mission: FloatArray) -> tuple[float, float, float, float]:
    x, y, z = T_map_mission[:3, 3].tolist()
    return x, y, z, float(np.rad2deg(np.arctan2(T_map_mission[1, 0], T_map_mission[0, 0])))


def view(
    context: typer.Context,
    *,
    rerun: Annotated[str, typer.Option(help="spawn, connect[=URL] or save=FILE.")] = "spawn",
    mesh: Annotated[
        Path | None, typer.Option(help="Also a surface, as `mesh` wrote it: .ply or .glb.")
    ] = None,
) -> None:
    """Show the map in Rerun: trajectories, loops by their switches, the cloud of all keyframes."""
    from mapstream.graph.tap_map import view_map  # noqa: PLC0415  # rerun takes its time
    from mapstream.graph.tap_sinks import SinkSpec  # noqa: PLC0415

    folder: Path = context.obj
    surface = read_mesh(mesh) if mesh is not None else None
    for note in view_map(load_map(folder), folder, SinkSpec.parse(rerun).open(), mesh=surface):
        complain(note)


def picture(
    context: typer.Context,
    file: Annotated[
        Path, typer.Argument(help="A .png from above, or an .html to turn in a browser.")
    ],
    *,
    set_: KeySetList = None,
) -> None:
    """Draw the map into a file, where there is no display for a viewer."""
    from mapstream.graph.map_picture import PictureConfig, write_picture  # noqa: PLC0415

    folder: Path = context.obj
    for note in write_picture(load_map(folder), folder, file, config_from(PictureConfig, set_)):
        complain(note)
    say(f"wrote {in_place(file)}")
