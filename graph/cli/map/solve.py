"""Verbs that solve for the poses of a map."""

from __future__ import annotations

from pathlib import Path

import typer

from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json
from mapstream.recordings.maps.history import change_map


def optimize(context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False) -> None:
    """Find the most likely poses of the whole map, and switch false loop closures off."""
    from mapstream.operators.estimation.batch import (  # noqa: PLC0415  # gtsam takes its time
        OptimizeConfig,
        optimize_map,
    )

    folder: Path = context.obj
    config = config_from(OptimizeConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    report = change_map(folder, "optimize", lambda map_: optimize_map(map_, config), **settings)
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
