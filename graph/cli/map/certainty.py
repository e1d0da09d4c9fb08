"""Verbs that say what to believe: false measurements, places of missions, covariances of states."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapstream.graph.cli.map.choosing import MissionOption
from mapstream.graph.cli.options import KeySetList, config_from
from mapstream.graph.cli.output import JsonFlag, in_place, say, say_json, say_table
from mapstream.operators.estimation.outliers.absolute_outliers import (
    RejectAbsoluteConfig,
    RejectAbsoluteReport,
)
from mapstream.operators.estimation.outliers.alignment import AlignConfig, align_missions
from mapstream.operators.estimation.outliers.fix_judge import without_false_fixes
from mapstream.operators.maps.missions import find_mission
from mapstream.operators.maps.outliers import RejectLoopsConfig, RejectLoopsReport, reject_loops
from mapstream.recordings.maps import Map, load_map, require_valid
from mapstream.recordings.maps.history import change_map

_AXES = ("roll deg", "pitch deg", "yaw deg", "x m", "y m", "z m")


def reject_outliers(
    context: typer.Context,
    *,
    loops: Annotated[
        bool, typer.Option("--loops", help="Loops, instead of absolute ones.")
    ] = False,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Switch off absolute measurements that contradict the others, or loops that contradict odometry."""
    folder: Path = context.obj
    report: RejectAbsoluteReport | RejectLoopsReport
    if loops:
        of_loops = config_from(RejectLoopsConfig, set_)
        settings = of_loops.model_dump(mode="json", exclude_defaults=True)
        report = change_map(
            folder, "reject-outliers", lambda m: reject_loops(m, of_loops), loops=True, **settings
        )
        num = report.num_loops
    else:
        config = config_from(RejectAbsoluteConfig, set_)
        settings = config.model_dump(mode="json", exclude_defaults=True)
        report = change_map(
            folder, "reject-outliers", lambda m: without_false_fixes(m, config), **settings
        )
        num = report.num_fixes
    if json:
        say_json(report)
        return
    what = "loops" if loops else "absolute measurements"
    say(f"{in_place(folder)}: {len(report.rejected)} of {num} {what} switched off")
    if report.num_untouched:
        say(f"{report.num_untouched} could not be judged, and stay as they are")


def align(context: typer.Context, *, set_: KeySetList = None, json: JsonFlag = False) -> None:
    """Find where missions lie to each other from the loops between them alone, false ones among them."""
    folder: Path = context.obj
    config = config_from(AlignConfig, set_)
    settings = config.model_dump(mode="json", exclude_defaults=True)
    report = change_map(folder, "align", lambda map_: align_missions(map_, config), **settings)
    if json:
        say_json(report)
        return
    say(f"{in_place(folder)}: {len(report.placed)} missions placed, {len(report.left)} left")
    say_table(
        ("mission", "and", "loops", "agree", "placed one"),
        [
            (
                p.mission_a[:8],
                p.mission_b[:8],
                p.num_loops,
                p.num_agreeing,
                "yes" if p.is_used else "no",
            )
            for p in report.pairs
        ],
    )


def covariance(
    context: typer.Context,
    *,
    mission: MissionOption = None,
    stamp_ns: Annotated[
        list[int] | None, typer.Option(help="Of a vertex; the last of each mission without.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Tell how certain poses of an optimised map are."""
    from mapstream.operators.estimation.covariance import covariances  # noqa: PLC0415  # gtsam

    folder: Path = context.obj
    map_ = require_valid(load_map(folder))
    rows = _vertices(map_, mission, stamp_ns)
    found = covariances(map_, rows)
    ids = [map_.mission_id(int(map_.vertices.mission[row])) for row in rows]
    stamps = [int(map_.vertices.stamp_ns[row]) for row in rows]
    if json:
        keys = ("mission_id", "stamp_ns", "covariance")
        poses = [
            dict(zip(keys, each, strict=True)) for each in zip(ids, stamps, found, strict=True)
        ]
        say_json({"path": folder, "poses": poses})
        return
    sigmas = np.sqrt(np.diagonal(found, axis1=1, axis2=2))
    sigmas[:, :3] = np.rad2deg(sigmas[:, :3])
    say("standard deviations, in the robot's frame")
    say_table(
        ("mission", "stamp ns", *_AXES),
        [(i[:8], *each) for i, *each in zip(ids, stamps, *sigmas.T.tolist(), strict=True)],
    )


def _vertices(map_: Map, mission: str | None, stamps_ns: list[int] | None) -> list[int]:
    """Return the rows of the vertices at these stamps, or of the last ones."""
    missions = range(len(map_.missions)) if mission is None else [find_mission(map_, mission)]
    if stamps_ns:
        chosen = [map_.vertex_rows(map_.mission_id(row), stamps_ns) for row in missions]
    else:
        chosen = [map_.vertices_of(row)[-1:] for row in missions]
    return [row for rows in chosen for row in rows.tolist()]
