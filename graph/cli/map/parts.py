"""Verbs that take parts out of a map, and put maps together."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Literal

import typer

from mapstream.graph.cli.map.choosing import MissionArgument
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.operators.maps.merge import MergeConfig, MergeReport
from mapstream.operators.maps.merge import merge as merge_tool
from mapstream.operators.maps.missions import find_mission
from mapstream.operators.maps.remove import Gap, RemovalReport, remove_missions, remove_range
from mapstream.recordings.maps import Map, load_map, require_valid
from mapstream.recordings.maps.history import change_map
from mapstream.streams.errors import MapError


def remove(  # one for each option of the command
    context: typer.Context,
    mission: MissionArgument,
    *,
    start_ns: Annotated[int | None, typer.Option(help="The first stamp that goes [ns].")] = None,
    end_ns: Annotated[int | None, typer.Option(help="The last stamp that goes [ns].")] = None,
    across: Annotated[
        Literal["link", "split"], typer.Option(help="Lead edges over the gap, or end the mission.")
    ] = "link",
    json: JsonFlag = False,
) -> None:
    """Remove a mission, or its vertices from one time to another."""
    folder: Path = context.obj
    times = {"start_ns": start_ns, "end_ns": end_ns}
    span = {name: stamp_ns for name, stamp_ns in times.items() if stamp_ns is not None}

    def removed(map_: Map) -> tuple[Map, RemovalReport]:
        row = find_mission(map_, mission)
        if not span:
            return remove_missions(map_, [row])
        return remove_range(map_, row, Gap.model_validate({**span, "across": across}))

    parameters = {**span, "across": across} if span else {}
    report = change_map(folder, "remove", removed, mission=mission, **parameters)
    if json:
        say_json(report)
        return
    links = f", {report.num_links} edges lead over the gap" if report.num_links else ""
    say(f"{in_place(folder)}: {report.num_vertices} vertices removed{links}")
    for mission_id in report.new_missions:
        say(f"mission {mission_id} begins after the gap")


def merge(
    context: typer.Context,
    others: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Maps to take in.")],
    *,
    common_frame: Annotated[
        bool, typer.Option("--common-frame", help="All maps share one map frame.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Take the missions of other maps into this one; parts of a mission that both have join."""
    folder: Path = context.obj
    config = MergeConfig(has_common_frame=common_frame)
    added = [require_valid(load_map(other), other) for other in others]

    def merged(map_: Map) -> tuple[Map, MergeReport]:
        together = merge_tool([map_, *added], config)
        for other, map_there in zip(others, added, strict=True):
            _copy_files(map_there, other, folder)  # files that no map names do no harm
        return together

    report = change_map(
        folder,
        "merge",
        merged,
        maps=[map_.digest()[:16] for map_ in added],
        common_frame=common_frame,
    )
    if json:
        say_json(report)
        return
    counts = f"{report.num_missions} missions, {report.num_vertices} vertices"
    say(f"{in_place(folder)}: {counts}")
    for mission_id in report.repeated:
        how = "joined from its parts" if mission_id in report.joined else "in this one once"
        say(f"mission {mission_id} was in several maps, and is {how}")


def _copy_files(map_: Map, source: Path, target: Path) -> None:
    """Copy the files that a map's resources name from its folder to another one."""
    resources = map_.resources
    for name in dict.fromkeys(resources.path[resources.topic == ""]):
        if (target / name).exists():
            continue
        try:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, target / name)
        except OSError as error:
            raise MapError(f"{target / name}: cannot be copied from {source}: {error}") from error
