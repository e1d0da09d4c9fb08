"""`mapstream localize`: where a robot was in a map that was made before."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.options import KeySetList
from mapstream.graph.cli.output import JsonFlag, in_place, plain, say, say_json, say_table
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.graph.cli.run_report import print_report
from mapstream.graph.cli.running import execute
from mapstream.graph.fit import topics_for
from mapstream.graph.trajectory_sources import TRUTH, read_trajectory
from mapstream.recordings.localization import LocalizationScore, read_map_poses, score_poses
from mapstream.recordings.maps import load_map
from mapstream.recordings.recording import Recording, open_recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import EncodedImage
from mapstream.streams.trajectory import Trajectory

POSES = "/map_poses"
_DETECTED = ("orb", "brisk", "freak", "sift")  # kinds of the operator `features`
_HEAD = """\
version: 1
name: localize
params:
  recording: {type: path}
operators:
"""
_SOURCE = "  sensors: {{use: mcap, config: {{path: $recording, topics: {topics}}}}}\n"
_CAMERA = """\
  decode_{n}: {{use: image_decode, in: {{images: sensors.camera_{n}}}, config: {{mode: gray}}}}
"""
_DETECTOR = """\
  {kind}_{n}: {{use: features, in: {{frames: decode_{n}.frames}}, config: {{kind: {kind}}}}}
"""


def localize(  # noqa: PLR0913  # one for each option of the command
    map_: Annotated[
        Path, typer.Argument(metavar="MAP", help="The folder of a map or its summary.")
    ],
    recording: Annotated[Path, typer.Argument(help="What the robot saw.")],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="A recording to write the poses to.")
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(help="A topic with images; all without; may be repeated.")
    ] = None,
    odometry: Annotated[
        str | None, typer.Option(help="A topic with odometry; none: each frame stands alone.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Poses in the map; the recording's /truth without.")
    ] = None,
    set_: KeySetList = None,
    json: JsonFlag = False,
) -> None:
    """Localise a recording in a map, and say how often and how well that worked."""
    with open_recording(recording) as opened:
        text = _graph(map_, opened, camera, odometry)
        has_truth = TRUTH in opened.topics
    with tempfile.TemporaryDirectory() as folder:
        graph, poses_file = Path(folder) / "localize.yaml", out or Path(folder) / "poses.mcap"
        graph.write_text(text.replace("OUT", str(poses_file)), encoding="utf-8")
        sets = [f"localize.{each}" for each in set_ or ()]
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


def _truth(path: Path | None) -> Trajectory | None:
    return None if path is None else read_trajectory(path)


def _graph(
    folder: Path, recording: Recording, cameras: Sequence[str] | None, odometry: str | None
) -> str:
    """Return the graph that localises a recording, as YAML.

    Raises:
        ConfigError: If the recording has no such topics, or the map no features that are detected here.
    """
    kinds = _kinds(folder)
    there = [topic.name for topic in topics_for(EncodedImage, recording)]
    chosen = list(cameras or sorted(there))
    with_poses = [topic.name for topic in topics_for(Odometry, recording) if topic.name != TRUTH]
    missing = [t for t in chosen if t not in there]
    missing += [odometry] if odometry is not None and odometry not in with_poses else []
    if missing or not chosen:
        known = ", ".join([*there, *with_poses]) or "none"
        raise ConfigError(
            f"{recording.path}: no topic {missing or 'with images'}; there are {known}"
        )
    topics = {f"camera_{n}": topic for n, topic in enumerate(chosen)}
    topics |= {"odometry": odometry} if odometry is not None else {}
    streams = {f"{kind}_{n}": f"{kind}_{n}.features" for n in range(len(chosen)) for kind in kinds}
    ports = "n_frames: n_frames.n_frames" + (", odometry: sensors.odometry" if odometry else "")
    lines = [_HEAD, _SOURCE.format(topics=_flow(topics))]
    for n in range(len(chosen)):
        lines.append(_CAMERA.format(n=n))
        lines += [_DETECTOR.format(n=n, kind=kind) for kind in kinds]
    lines.append(
        f"  n_frames: {{use: n_frames, in: {_flow(streams)}, config: {{inputs: [{', '.join(streams)}]}}}}\n"
        f'  localize: {{use: localize, in: {{{ports}}}, config: {{map: "{folder.absolute()}"}}}}\n'
        '  poses: {use: mcap_sink, in: {poses: localize.poses}, config: {path: "OUT",'
        f" schemas: mapstream, topics: {{poses: {POSES}}}}}}}\n"
    )
    return "".join(lines)


def _kinds(folder: Path) -> list[str]:
    kinds = sorted(set(load_map(folder, tables=["landmarks"]).landmarks.kind.tolist()))
    known = [kind for kind in kinds if kind in _DETECTED]
    if not known:
        raise ConfigError(
            f"{folder}: its landmarks are of the kinds {', '.join(kinds) or 'none'}, and this command detects"
            f" {', '.join(_DETECTED)}; write a graph with your detectors and the operator localize"
        )
    return known


def _flow(items: dict[str, str]) -> str:
    return "{" + ", ".join(f"{name}: {value}" for name, value in items.items()) + "}"


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
