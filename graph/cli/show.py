"""`mapstream graph`: a drawing of a graph."""

from __future__ import annotations

from typing import Annotated

import typer

from mapstream.graph import show
from mapstream.graph.cli.output import JsonFlag, ParamList, ProfileName, SetList, given, say_json
from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.wiring import type_name


def graph(
    graph: Annotated[str, typer.Argument(help="A graph file, or the name of a preset.")],
    *,
    mermaid: Annotated[bool, typer.Option("--mermaid", help="As a Mermaid flowchart.")] = False,
    param: ParamList = None,
    set_: SetList = None,
    profile: ProfileName = "replay",
    json: JsonFlag = False,
) -> None:
    """Draw a graph: its operators, what flows between them, and where they run."""
    params = given(param, "--param")
    loaded = load_graph(graph, params=params, sets=set_ or (), profile=profile, needs_values=False)
    planned = plan(loaded)
    if not json:
        typer.echo(show.mermaid(planned) if mermaid else show.text(planned), nl=False)
        return
    say_json(
        {
            "name": planned.name,
            "operators": [
                {"name": n.name, "use": n.use, "placement": n.placement, "workers": n.workers}
                for n in planned.nodes.values()
            ],
            "edges": [
                {
                    "from": f"{e.from_node}.{e.from_port}",
                    "to": f"{e.to_node}.{e.to_port}",
                    "type": type_name(e.message_type),
                    "limits": e.limits,
                    "feedback": e.is_feedback,
                }
                for e in planned.edges
            ],
        }
    )
