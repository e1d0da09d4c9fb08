"""`mapstream check`: what is wrong with a graph, before it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    ParamList,
    ProfileName,
    SetList,
    complain,
    given,
    say,
    say_json,
)
from mapstream.graph.cli.planning import Planned, Request, plan_request
from mapstream.graph.problems import GraphError, Problem, dotted


def check(
    graph: Annotated[str, typer.Argument(help="A graph file, or the name of a preset.")],
    recording: Annotated[
        Path | None, typer.Argument(help="A recording, to check topics and types as well.")
    ] = None,
    *,
    param: ParamList = None,
    set_: SetList = None,
    profile: ProfileName = "replay",
    json: JsonFlag = False,
) -> None:
    """Find all mistakes of a graph without running it; with a recording, also whether the two fit."""
    request = Request(
        graph=graph,
        recording=recording,
        params=given(param, "--param"),
        sets=set_ or (),
        profile=profile,
        needs_values=False,
    )
    planned: Planned | None = None
    problems: tuple[Problem, ...] = ()
    try:
        planned = plan_request(request)
    except GraphError as error:
        problems = error.problems
    if json:
        say_json(_as_json(planned, problems))
    else:
        _tell(planned, problems)
    if problems:
        raise typer.Exit(ExitCode.UNUSABLE)


def _tell(planned: Planned | None, problems: tuple[Problem, ...]) -> None:
    for problem in problems:
        complain(str(problem))
    if planned is not None:
        plan = planned.plan
        for line in [*(f"warning: {text}" for text in plan.warnings), *planned.notes]:
            say(line)
        say(f"{plan.name}: {len(plan.nodes)} operators, {len(plan.edges)} edges, no problems")


def _as_json(planned: Planned | None, problems: tuple[Problem, ...]) -> dict[str, object]:
    return {
        "problems": [
            {
                "file": problem.position.source,
                "line": problem.position.line,
                "column": problem.position.column,
                "key": dotted(problem.path),
                "message": problem.message,
            }
            for problem in problems
        ],
        "warnings": planned.plan.warnings if planned else [],
        "notes": planned.notes if planned else [],
    }
