"""`mapstream demo`: a whole run on a machine that has nothing but mapstream."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from mapstream.graph.cli.evaluate import Score, compare
from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    complain,
    in_place,
    say,
    say_aside,
    say_json,
)
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.graph.cli.run_report import print_report, report_as_json
from mapstream.graph.cli.running import execute
from mapstream.graph.cli.simulate import write_world
from mapstream.graph.problems import did_you_mean
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.recordings.maps import check_map, load_map
from mapstream.recordings.worlds.catalogue import WORLDS
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo:
    """A world, and the graph that maps it."""

    summary: str
    world: str
    options: dict[str, Any]
    graph: str = "lidar"


DEMOS = {
    "corridor": Demo(
        summary="a LiDAR in a loop of corridors",
        world="w_lid",
        options={"length_m": 80.0, "lidar": {"columns": 360}},
    ),
}


def demo(
    name: Annotated[str, typer.Argument(help=", ".join(DEMOS))] = "corridor",
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="A folder for the results; a new one without.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the simulation.")] = 0,
    rerun: Annotated[
        str | None,
        typer.Option("--rerun", help="spawn, connect, save=FILE or off; a file in OUT without."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Simulate a drive, map it, compare the map with the truth, and say where everything is."""
    if name not in DEMOS:
        raise ConfigError(f"no demo {name!r}{did_you_mean(name, DEMOS)}")
    chosen = DEMOS[name]
    folder = Path(tempfile.mkdtemp(prefix="mapstream-demo-")) if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    recording, map_folder, picture = folder / "drive.mcap", folder / "map", folder / "run.rrd"
    config = WORLDS[chosen.world].config_type.model_validate(chosen.options)
    if not json:
        say_aside(f"simulating {chosen.summary}")
    write_world(chosen.world, recording, config, seed=seed)
    request = Request(
        graph=chosen.graph,
        recording=recording,
        params={"map": str(map_folder)},
        sets=["store.on_existing=replace"],  # a demo may be run again
    )
    plan = plan_request(request).plan
    report, notes = execute(plan, rerun=rerun or f"save={picture}", has_progress=not json)
    if report.status == "failed":
        print_report(report)
        raise typer.Exit(report.exit_code)
    violations = check_map(load_map(map_folder), map_folder)
    score = compare(read_trajectory(map_folder), read_trajectory(recording), "se3")
    if json:
        results = {"folder": folder, "score": score, "violations": violations, "viewer": notes}
        say_json(report_as_json(report) | results)
    else:
        print_report(report)
        say()
        _tell(score, folder, map_folder)
    for violation in violations:
        complain(str(violation))
    raise typer.Exit(ExitCode.FAILED if violations else report.exit_code)


def _tell(score: Score, folder: Path, map_folder: Path) -> None:
    """Say how good the map is, where everything lies, and what one may do next."""
    error = score.errors["absolute, translation [m]"]
    say(
        f"against the truth: {error.rmse:.3f} m rms, {error.max:.3f} m at worst, over {score.length_m:.0f} m"
    )
    for path in sorted(folder.iterdir()):
        say(f"  {in_place(path)}")
    say(f"next: mapstream map {in_place(map_folder)} stats")
    picture = folder / "run.rrd"
    if picture.exists():
        say(f"      rerun {in_place(picture)}")
