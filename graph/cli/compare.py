"""`mapstream compare`: the same recording through several graphs, or one graph with several choices, as a table."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from mapstream.graph.cli.evaluate import Score, score_of
from mapstream.graph.cli.output import (
    ExitCode,
    JsonFlag,
    ParamList,
    SetList,
    complain,
    given,
    in_place,
    plain,
    say,
    say_aside,
    say_json,
    say_table,
)
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.graph.cli.running import execute
from mapstream.graph.report import RunReport
from mapstream.graph.trajectory_sources import TRUTH, read_trajectory
from mapstream.recordings.evaluation import AlignmentMode, associate
from mapstream.recordings.maps.store import MANIFEST
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import ConfigError, MappingError
from mapstream.streams.trajectory import Trajectory

_TRANSLATION = "absolute, translation [m]"
_ROTATION = "absolute, rotation [deg]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One way to run: a graph and what is chosen in it."""

    graph: str
    choices: tuple[tuple[str, str], ...] = ()  # OPERATOR.KEY or a parameter, and its value

    @property
    def name(self) -> str:
        graph = Path(self.graph).stem
        return " ".join([graph, *(f"{key.rpartition('.')[2]}={v}" for key, v in self.choices)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What came of one variant."""

    name: str
    graph: str
    choices: dict[str, str]
    status: str  # complete, lossy, failed
    reason: str  # why it is not complete
    seconds: float
    times_real_time: float
    cpu_seconds: float
    score: Score | None  # None without a reference, or where the run failed


def compare(  # noqa: PLR0913  # one for each option of the command
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="GRAPH... RECORDING", help="Graph files or presets, and the recording."
        ),
    ],
    *,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OPERATOR.KEY=A,B,...",
            help="Values to compare, a list in brackets: [],[a],[a,b]; without a dot, of a parameter."
            " Several: every combination.",
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            help="A topic of the recording, or a file as `eval` takes it; /truth without."
        ),
    ] = None,
    align: Annotated[AlignmentMode, typer.Option(help="se3, sim3, yaw or none.")] = "se3",
    keep: Annotated[
        Path | None, typer.Option(help="A folder to keep the maps in, one per variant.")
    ] = None,
    param: ParamList = None,
    set_: SetList = None,
    json: JsonFlag = False,
) -> None:
    """Run every variant on a recording, and compare errors and times."""
    if len(words) < 2:
        raise ConfigError("compare: expected graphs and, last, a recording")
    *graphs, last = words
    recording = Path(last)
    reference = _reference(recording, truth)
    if reference is None:
        say_aside(f"{recording.name}: no {TRUTH} and no --truth, so only times are compared")
    request = Request(
        graph="", recording=recording, params=given(param, "--param"), sets=set_ or ()
    )
    outcomes = []
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for number, variant in enumerate(variants(graphs, vary or ())):
            say_aside(f"running {variant.name}")
            place = folder / f"{number:02d}-{variant.name.replace(' ', '-').replace('/', '-')}"
            outcomes.append(_run(variant, request, place, reference, align))
    if json:
        say_json({"recording": recording, "align": align, "variants": plain(outcomes)})
    else:
        _tell(outcomes, align, has_reference=reference is not None)
        if keep is not None:
            say(f"maps are in {in_place(keep)}")
    if any(each.status == "failed" for each in outcomes):
        raise typer.Exit(ExitCode.FAILED)


def variants(graphs: Sequence[str], vary: Sequence[str]) -> Iterator[Variant]:
    """Yield every combination of graphs and values, the last option fastest.

    Raises:
        ConfigError: If an option is not written KEY=A,B.
    """
    options = list[list[tuple[str, str]]]()
    for text in vary:
        key, equals, values = text.partition("=")
        if not (equals and key and values):
            raise ConfigError(f"--vary {text}: expected OPERATOR.KEY=A,B,...")
        options.append([(key, value) for value in _split(values)])
    for graph in graphs:
        for choices in itertools.product(*options):
            yield Variant(graph=graph, choices=choices)


def _split(values: str) -> list[str]:
    """Return the values between commas that are in no bracket."""
    parts, depth = [""], 0
    for letter in values:
        depth += (letter in "[{") - (letter in "]}")
        if letter == "," and not depth:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _reference(recording: Path, truth: str | None) -> Trajectory | None:
    with open_recording(recording) as opened:
        topics = opened.topics.keys()
    if truth is None:
        return read_trajectory(recording, topic=TRUTH) if TRUTH in topics else None
    is_topic = truth in topics
    return read_trajectory(
        recording if is_topic else Path(truth), topic=truth if is_topic else None
    )


def _run(
    variant: Variant,
    request: Request,
    place: Path,
    reference: Trajectory | None,
    align: AlignmentMode,
) -> Outcome:
    """Run one variant into a folder; one that fails has no score, and does not end the others."""
    params = request.params | {"map": str(place)}
    params |= {key: value for key, value in variant.choices if "." not in key}
    sets = [f"{key}={value}" for key, value in variant.choices if "." in key]
    wanted = replace(request, graph=variant.graph, params=params, sets=[*request.sets, *sets])
    report, _ = execute(plan_request(wanted).plan, has_progress=False)
    reason, score = "; ".join(report.reasons), None
    if reference is not None and report.status != "failed":
        try:
            estimate = read_trajectory(_estimate(report, place))
            score = score_of(associate(estimate, reference, interpolate=True), align)
        except MappingError as error:
            reason = str(error)
    return Outcome(
        name=variant.name,
        graph=variant.graph,
        choices=dict(variant.choices),
        status=report.status,
        reason=reason,
        seconds=report.final.wall_s,
        times_real_time=report.final.speed,
        cpu_seconds=report.final.cpu_s,
        score=score,
    )


def _estimate(report: RunReport, place: Path) -> Path:
    """Return what a run left to be judged: its map, or a trajectory."""
    if (place / MANIFEST).is_file():
        return place
    files = [Path(path) for path in report.written if Path(path).suffix in (".tum", ".csv", ".txt")]
    if not files:
        raise ConfigError("the graph leaves neither a map nor a trajectory; add a map_store")
    return files[0]


def _tell(outcomes: Sequence[Outcome], align: AlignmentMode, *, has_reference: bool) -> None:
    if has_reference:
        say(f"errors against the reference, alignment {align}")
    columns = ("variant", "rmse m", "max m", "rmse deg", "drift %", "s", "x real time", "cpu s")
    rows = []
    for each in outcomes:
        errors = each.score.errors if each.score is not None else None
        kitti = each.score.kitti if each.score is not None else None
        rows.append(
            (
                each.name,
                errors[_TRANSLATION].rmse if errors else float("nan"),
                errors[_TRANSLATION].max if errors else float("nan"),
                errors[_ROTATION].rmse if errors else float("nan"),
                kitti.translation_percent if kitti else float("nan"),
                each.seconds,
                each.times_real_time,
                each.cpu_seconds,
            )
        )
    say_table(columns, rows)
    for each in outcomes:
        if each.reason:
            complain(f"{each.name}: {each.status}: {each.reason}")
