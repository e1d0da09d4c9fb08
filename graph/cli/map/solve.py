"""Verbs that solve for the poses of a map; what makes it worse is not kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from mapstream.graph.cli.map.choosing import MissionOption
from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, complain, in_place, plain, say, say_json
from mapstream.operators.maps.missions import find_mission
from mapstream.operators.maps.quality import require_no_worse
from mapstream.recordings.loop_files import read_loops
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.history import change_map

if TYPE_CHECKING:
    from mapstream.operators.estimation.batch import OptimizationReport

ReportT = TypeVar("ReportT")
KeepFlag = Annotated[
    bool, typer.Option("--keep", help="Also where odometry contradicts the solution.")
]


def optimize(
    context: typer.Context,
    *,
    keep: KeepFlag = False,
    labels: Annotated[
        Path | None, typer.Option(help="Lines of NUMBER and 0 or 1, false, for edges as imported.")
    ] = None,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Find the most likely poses of the whole map, and switch false loop closures off."""
    from mapstream.operators.estimation.batch import (  # noqa: PLC0415  # gtsam takes its time
        OptimizeConfig,
        optimize_map,
    )
    from mapstream.operators.estimation.outliers.scores import read_labels, score_loops  # noqa: PLC0415

    folder: Path = context.obj
    config = config_from(OptimizeConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    tool = _guarded(lambda map_: optimize_map(map_, config), keep=keep, may_switch=config.is_robust)
    is_false = read_labels(labels) if labels is not None else None
    report = change_map(folder, "optimize", tool, **settings)
    score = score_loops(load_map(folder), is_false) if is_false is not None else None
    if json:
        say_json(report if score is None else {**plain(report), "score": plain(score)})
        return
    _tell(folder, report)
    if score is not None:
        kept = f"{score.num_false_kept} of {score.num_false} false loops kept"
        dropped = f"{score.num_true_dropped} true ones dropped"
        say(f"{kept}, {dropped}: precision {score.precision:.4f}, recall {score.recall:.4f}")


def relax(  # noqa: PLR0913  # one for each option of the command
    context: typer.Context,
    *,
    mission: MissionOption = None,
    each: Annotated[bool, typer.Option("--each", help="Every mission for itself.")] = False,
    loops: Annotated[
        Path | None, typer.Option(help="YAML or CSV; they take part, and are not in the map after.")
    ] = None,
    keep: KeepFlag = False,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Relax the pose graph: all missions together, each for itself, or one."""
    from mapstream.operators.estimation.batch import OptimizeConfig  # noqa: PLC0415
    from mapstream.operators.maps.relax import (  # noqa: PLC0415
        RelaxReport,
        relax_map,
        relax_missions,
    )

    folder: Path = context.obj
    config = config_from(OptimizeConfig, set_)
    external = read_loops(loops) if loops is not None else []

    def relaxed(map_: Map) -> tuple[Map, RelaxReport]:
        if mission is not None:
            return relax_missions(map_, [find_mission(map_, mission)], external, config)
        if each:
            return relax_missions(map_, range(len(map_.missions)), external, config)
        return relax_map(map_, external, config)

    settings = config.model_dump(mode="json", exclude_defaults=True)
    settings |= {"mission": mission, "each": each or None, "loops": loops.name if loops else None}
    report = change_map(
        folder, "relax", _guarded(relaxed, keep=keep, may_switch=config.is_robust), **settings
    )
    if json:
        say_json(report)
        return
    for reason, count in report.loops.left_out.items():
        complain(f"left out: {count} loops: {reason}")
    if external:
        say(f"{report.loops.num_added} loops took part, and are not in the map")
    for solution in report.solved:
        _tell(folder, solution)


def _guarded(
    tool: Callable[[Map], tuple[Map, ReportT]], *, keep: bool, may_switch: bool
) -> Callable[[Map], tuple[Map, ReportT]]:
    """Return the tool that refuses a solution which odometry contradicts, unless it is kept all the same."""

    def guarded(map_: Map) -> tuple[Map, ReportT]:
        solved, report = tool(map_)
        if not keep:
            require_no_worse(map_, solved, may_switch=may_switch)
        return solved, report

    return guarded


def _tell(folder: Path, report: OptimizationReport) -> None:
    say(f"{in_place(folder)}: {report.num_vertices} vertices")
    for line in report.lines():
        say(line)
