"""`mapstream run`: a graph, on a recording or on live sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.dataset_cache import converted
from mapstream.graph.cli.output import (
    JsonFlag,
    ParamList,
    ProfileName,
    SetList,
    given,
    in_place,
    say,
    say_aside,
    say_json,
)
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.graph.cli.run_report import print_report, report_as_json
from mapstream.graph.cli.running import execute
from mapstream.graph.plan import Plan

RerunOption = Annotated[
    str, typer.Option("--rerun", help="spawn, connect, connect=URL, save=FILE or off.")
]


def run(  # noqa: PLR0913  # one for each option of the command
    graph: Annotated[str, typer.Argument(help="A graph file, or the name of a preset.")],
    recording: Annotated[Path | None, typer.Argument(help="The recording to read.")] = None,
    *,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="A data set in the place of a recording, as `mapstream convert` names it: euroc:DIR, "
            "kitti:DIR ... It is converted once, into the cache."
        ),
    ] = None,
    map_: Annotated[Path | None, typer.Option("--map", help="The folder of the map.")] = None,
    param: ParamList = None,
    set_: SetList = None,
    profile: ProfileName = "replay",
    rate: Annotated[
        str | None,
        typer.Option(help="Times real time, such as 1.0; max; or auto, which follows the queues."),
    ] = None,
    start_s: Annotated[
        float | None, typer.Option("--start", help="Seconds into the recording.")
    ] = None,
    end_s: Annotated[
        float | None, typer.Option("--end", help="Seconds into the recording.")
    ] = None,
    rerun: RerunOption = "off",
    trace: Annotated[
        Path | None,
        typer.Option(help="A file to fill with snapshots of the run, a line of JSON each."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Run a graph. Ctrl-C stops the sources, finishes what is under way and saves; again: quits."""
    if dataset is not None and recording is not None:
        raise typer.BadParameter("--dataset takes the place of the recording; give one of them")
    recording = recording if dataset is None else converted(dataset)
    params = given(param, "--param")
    if map_ is not None:
        params["map"] = str(map_)
    request = Request(
        graph=graph, recording=recording, params=params, sets=set_ or (), profile=profile
    )
    section = {"start_s": start_s, "end_s": end_s}
    request = replace(request, sets=[*_section_of(request, section), *request.sets])
    planned = plan_request(request)
    plan = planned.plan if rate is None else _at_rate(planned.plan, rate)
    for line in [*(f"warning: {warning}" for warning in plan.warnings), *planned.notes]:
        say_aside(line)
    report, notes = execute(plan, rerun=rerun, trace=trace, has_progress=not json)
    if json:
        say_json(report_as_json(report) | {"viewer": notes, "written": report.written})
    else:
        print_report(report)
        for note in notes:
            say_aside(f"viewer: {note}")
        for path in report.written:
            say(f"wrote {in_place(Path(path))}")
    raise typer.Exit(report.exit_code)


def _section_of(request: Request, section: dict[str, float | None]) -> list[str]:
    """Return `--set` options that make the readers of the recording begin or end elsewhere."""
    given_ones = {key: value for key, value in section.items() if value is not None}
    if not given_ones:
        return []
    readers = [
        name
        for name, operator in request.load().spec.operators.items()
        if request.recording is not None and operator.config.get("path") == str(request.recording)
    ]
    if not readers:
        raise typer.BadParameter("--start and --end need a recording that the graph reads")
    return [f"{name}.{key}={value}" for name in readers for key, value in given_ones.items()]


def _at_rate(plan: Plan, rate: str) -> Plan:
    """Return the plan with its clock at another rate."""
    if plan.profile.clock.from_ == "wall":
        raise typer.BadParameter(
            f"--rate is for replays; the profile {plan.profile_name!r} runs by the wall clock"
        )
    try:
        value = rate if rate in ("max", "auto") else float(rate)
    except ValueError:
        raise typer.BadParameter(f"expected a number, max or auto, found {rate!r}") from None
    if isinstance(value, float) and not 0 < value < float("inf"):
        raise typer.BadParameter(f"expected more than 0, found {rate!r}")
    clock = plan.profile.clock.model_copy(update={"rate": value})
    return replace(plan, profile=plan.profile.model_copy(update={"clock": clock}))
