"""`mapstream localize`: where a robot was in a map that was made before."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.localize_graphs import (
    OPERATOR,
    POSES,
    camera_graph,
    is_for_lidar,
    lidar_graph,
)
from mapstream.graph.cli.localize_laser import is_for_laser, laser_graph
from mapstream.graph.cli.localize_planes import is_for_planes, planes_graph
from mapstream.graph.cli.options import KeySetList
from mapstream.graph.cli.output import JsonFlag, in_place, plain, say, say_json, say_table
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.graph.cli.run_report import print_report
from mapstream.graph.cli.running import execute
from mapstream.graph.trajectory_sources import TRUTH, read_trajectory
from mapstream.recordings.localization import LocalizationScore, read_map_poses, score_poses
from mapstream.recordings.recording import Recording, open_recording
from mapstream.streams.trajectory import Trajectory


def localize(  # noqa: PLR0913  # one for each option of the command
    map_: Annotated[
        Path,
        typer.Argument(
            metavar="MAP",
            help="The folder of a map or its summary, or an occupancy grid's YAML file.",
        ),
    ],
    recording: Annotated[Path, typer.Argument(help="What the robot saw.")],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="A recording to write the poses to.")
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(help="A topic with images; all without; may be repeated.")
    ] = None,
    lidar: Annotated[
        str | None,
        typer.Option(help="A topic with scans; chosen by itself where the map has clouds alone."),
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(
            help="A topic with odometry; without, each frame stands alone, and a LiDAR has its own."
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Poses in the map; the recording's /truth without.")
    ] = None,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Localise a recording in a map, and say how often and how well that worked."""
    with open_recording(recording) as opened:
        text = _graph(map_, opened, camera, lidar, odometry)
        has_truth = TRUTH in opened.topics
    with tempfile.TemporaryDirectory() as folder:
        graph, poses_file = Path(folder) / "localize.yaml", out or Path(folder) / "poses.mcap"
        graph.write_text(text.replace("OUT", str(poses_file)), encoding="utf-8")
        sets = [f"{OPERATOR}.{each}" for each in set_ or ()]
        plan = plan_request(Request(graph=str(graph), recording=recording, sets=sets)).plan
        report, _ = execute(plan, has_progress=not json)
        if report.status == "failed":
            print_report(report)
            raise typer.Exit(report.exit_code)
        poses = read_map_poses(poses_file, POSES)
    reference = _truth(truth or (recording if has_truth else None))
    score = score_poses(poses, reference)
    if json:
        say_json({**plain(score), "exit_code": report.exit_code})
    else:
        _tell(score, in_place(out) if out is not None else None)
    raise typer.Exit(report.exit_code)


def _graph(
    map_: Path,
    recording: Recording,
    camera: list[str] | None,
    lidar: str | None,
    odometry: str | None,
) -> str:
    """Return the graph for what was asked for, else for what the map and the recording have in common."""
    is_open = camera is None and lidar is None
    if is_open and is_for_laser(map_, recording):
        return laser_graph(map_, recording, odometry)
    if is_open and is_for_planes(map_, recording):
        return planes_graph(map_, recording, odometry)
    if lidar is not None or (is_open and is_for_lidar(map_, recording)):
        return lidar_graph(map_, recording, lidar, odometry)
    return camera_graph(map_, recording, camera, odometry)


def _truth(path: Path | None) -> Trajectory | None:
    return None if path is None else read_trajectory(path)


def _tell(score: LocalizationScore, out: str | None) -> None:
    states = ", ".join(f"{count} {state}" for state, count in score.states.items())
    say(f"{score.num_found} of {score.num_poses} poses found: {states or 'none'}")
    if score.distance_m is not None and score.angle_deg is not None:
        say(f"recall {score.recall:.3f}, precision {score.precision:.3f}")
        columns = ("median", "mean", "rmse", "max")
        errors = {"distance [m]": score.distance_m, "angle [deg]": score.angle_deg}
        rows = [(name, *(getattr(each, c) for c in columns)) for name, each in errors.items()]
        say_table(("error", *columns), rows)
    if out is not None:
        say(f"wrote {out}")
