"""`mapstream demo`: a whole run on a machine that has nothing but mapstream."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.dataset_cache import converted
from mapstream.graph.cli.demo_judges import (
    Judge,
    Judgement,
    against_end_of_v101,
    against_truth,
    against_unused_positions,
)
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
from mapstream.recordings.maps import check_map, load_map
from mapstream.recordings.worlds.catalogue import WORLDS
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo:
    """A recording that every machine can have, the graph that maps it, and what the map is judged by."""

    summary: str
    record: Callable[[Path, int], Path]  # a folder and a seed -> the recording
    graph: str
    judge: Judge
    params: Callable[[Path], dict[str, str]] = lambda _: {}  # of the graph, for the recording


def _corridor(folder: Path, seed: int) -> Path:
    recording = folder / "drive.mcap"
    options = {"length_m": 80.0, "lidar": {"columns": 360}}
    write_world("w_lid", recording, WORLDS["w_lid"].config_type.model_validate(options), seed=seed)
    return recording


def _kitti00(folder: Path, seed: int) -> Path:  # noqa: ARG001  # it lies in the cache, and is real
    return converted("kitti00-gtsam")


def _euroc(folder: Path, seed: int) -> Path:  # noqa: ARG001  # as above
    return converted("eqvio")


def _inertial_params(recording: Path) -> dict[str, str]:  # noqa: ARG001  # as other demos ask it
    """Return how few positions are used; the others judge the map, for so few cannot judge each other."""
    return {"position_period_s": "10"}


DEMOS = {
    "kitti00": Demo(
        summary="a real car, KITTI 00: IMU, and GPS every ten seconds",
        record=_kitti00,
        graph="gnss_inertial",
        judge=against_unused_positions,
        params=_inertial_params,
    ),
    "euroc": Demo(
        summary="a real drone, EuRoC V1_01: 30 s of feature tracks of one camera, and IMU",
        record=_euroc,
        graph="tracks_inertial",
        judge=against_end_of_v101,
    ),
    "corridor": Demo(
        summary="a simulated LiDAR in a loop of corridors",
        record=_corridor,
        graph="lidar",
        judge=against_truth,
    ),
}


def demo(
    name: Annotated[
        str, typer.Argument(help="; ".join(f"{n}: {d.summary}" for n, d in DEMOS.items()) + ".")
    ] = "kitti00",
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="A folder for the results; a new one without.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of a simulation.")] = 0,
    truth: Annotated[
        Path | None,
        typer.Option(help="Judge by this instead: a TUM, KITTI or EuRoC file, or a recording."),
    ] = None,
    rerun: Annotated[
        str | None,
        typer.Option("--rerun", help="spawn, connect, save=FILE or off; a file in OUT without."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Map a drive, judge the map by what it was not made of, and say where everything is."""
    if name not in DEMOS:
        raise ConfigError(f"no demo {name!r}{did_you_mean(name, DEMOS)}")
    chosen = DEMOS[name]
    folder = Path(tempfile.mkdtemp(prefix="mapstream-demo-")) if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    map_folder, picture = folder / "map", folder / "run.rrd"
    if not json:
        say_aside(chosen.summary)
    recording = chosen.record(folder, seed)
    request = Request(
        graph=chosen.graph,
        recording=recording,
        params={"map": str(map_folder)} | chosen.params(recording),
        sets=["store.on_existing=replace"],  # a demo may be run again
    )
    plan = plan_request(request).plan
    report, notes = execute(plan, rerun=rerun or f"save={picture}", has_progress=not json)
    if report.status == "failed":
        print_report(report)
        raise typer.Exit(report.exit_code)
    violations = check_map(load_map(map_folder), map_folder)
    judgement = (
        chosen.judge(map_folder, recording) if truth is None else against_truth(map_folder, truth)
    )
    if json:
        results = {"folder": folder, "recording": recording, "judgement": judgement}
        say_json(report_as_json(report) | results | {"violations": violations, "viewer": notes})
    else:
        print_report(report)
        say()
        _tell(judgement, folder, recording)
    for violation in violations:
        complain(str(violation))
    raise typer.Exit(ExitCode.FAILED if violations else report.exit_code)


def _tell(judgement: Judgement, folder: Path, recording: Path) -> None:
    """Say how good the map is, where everything lies, and what one may do next."""
    error = judgement.distance_m
    far = f"{error.rmse:.3f} m rms, {error.max:.3f} m at worst, over {judgement.length_m:.0f} m"
    say(f"against {judgement.against}: {far}")
    for path in sorted({*folder.iterdir(), recording}):
        say(f"  {in_place(path)}")
    say(f"next: mapstream map {in_place(folder / 'map')} stats")
    picture = folder / "run.rrd"
    if picture.exists():
        say(f"      rerun {in_place(picture)}")
