"""`mapstream eval`: how far an estimate is from a reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from mapstream.graph.cli.evaluate_robots import Pairing, evaluate_robots, robots_of
from mapstream.graph.cli.output import JsonFlag, say, say_json, say_table
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.recordings.evaluation import (
    AlignmentMode,
    KittiDrift,
    PosePairs,
    Statistics,
    ape,
    associate,
    kitti_drift,
    rpe,
)
from mapstream.streams.errors import ConfigError, EstimationError
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One comparison: statistics of errors, by what they are."""

    num_pairs: int
    length_m: float  # of the reference, over the pairs
    errors: dict[str, Statistics]
    kitti: KittiDrift | None  # None: shorter than 100 m
    skipped: tuple[str, ...] = ()  # what could not be measured, and why


def evaluate(  # noqa: PLR0913  # one for each option of the command
    estimate: Annotated[
        Path, typer.Argument(help="A map, a recording, or a TUM, KITTI or EuRoC file.")
    ],
    references: Annotated[
        list[str],
        typer.Argument(
            metavar="REFERENCE...",
            help="What it is judged by; the same kinds. Of a map with several missions: MISSION=PATH for"
            " each, or one map with the same missions.",
        ),
    ],
    *,
    align: Annotated[AlignmentMode, typer.Option(help="se3, sim3, yaw or none.")] = "se3",
    max_difference_s: Annotated[
        float, typer.Option("--max-difference", help="Between the stamps of a pair [s].")
    ] = 0.02,
    interpolate: Annotated[
        bool, typer.Option("--interpolate", help="Ask the reference between its poses.")
    ] = False,
    delta: Annotated[float, typer.Option(help="Of relative errors.")] = 1.0,
    unit: Annotated[Literal["frames", "m"], typer.Option(help="Of delta.")] = "frames",
    topic: Annotated[str | None, typer.Option(help="With the poses, of a recording.")] = None,
    mission: Annotated[str | None, typer.Option(help="Of a map with several.")] = None,
    json: JsonFlag = False,
) -> None:
    """Compare a trajectory or map with a reference: absolute and relative errors, KITTI drift."""
    pairing = Pairing(
        topic=topic,
        max_difference_ns=round(max_difference_s * 1e9),
        interpolate=interpolate,
    )
    robots = robots_of(estimate, references) if mission is None else None
    if robots is not None:
        evaluate_robots(robots, pairing, align, json=json)
        return
    if len(references) > 1:
        raise ConfigError("eval: several references: say which mission each is of, MISSION=PATH")
    pairs = pairing.pairs(
        read_trajectory(estimate, topic=topic, mission=mission),
        read_trajectory(Path(references[0]), topic=topic),
    )
    score = score_of(pairs, align, delta=delta, unit=unit)
    if json:
        say_json(score)
    else:
        print_score(score, align)


def compare(estimate: Trajectory, reference: Trajectory, align: AlignmentMode) -> Score:
    """Return the errors of an estimate at its own stamps.

    Raises:
        EstimationError: If the two share no time, or cannot be aligned.
    """
    return score_of(associate(estimate, reference, interpolate=True), align)


def score_of(
    pairs: PosePairs,
    align: AlignmentMode,
    *,
    delta: float = 1.0,
    unit: Literal["frames", "m"] = "frames",
) -> Score:
    """Return the errors of paired poses.

    Raises:
        EstimationError: If the positions do not determine the alignment.
    """
    absolute = ape(pairs, align)
    errors = {
        "absolute, translation [m]": absolute.translation,
        "absolute, rotation [deg]": Statistics.of(np.rad2deg(absolute.rotation_rad)),
    }
    skipped = []
    try:
        relative = rpe(pairs, delta=delta, unit=unit)
        over = f"relative over {delta:g} {unit}"
        errors[f"{over}, translation [m]"] = relative.translation
        errors[f"{over}, rotation [deg]"] = Statistics.of(np.rad2deg(relative.rotation_rad))
    except EstimationError as error:
        skipped.append(str(error))
    kitti = None
    try:
        kitti = kitti_drift(pairs)
    except EstimationError as error:
        skipped.append(str(error))
    steps_m = np.linalg.norm(np.diff(pairs.reference[:, :3, 3], axis=0), axis=1)
    return Score(
        num_pairs=len(pairs),
        length_m=float(steps_m.sum()),
        errors=errors,
        kitti=kitti,
        skipped=tuple(skipped),
    )


def print_score(score: Score, align: AlignmentMode) -> None:
    """Print a table of the errors."""
    say(f"{score.num_pairs} poses over {score.length_m:.1f} m, alignment {align}")
    columns = ("rmse", "mean", "median", "std", "min", "max")
    say_table(
        ("error", *columns),
        [(name, *(getattr(s, c) for c in columns)) for name, s in score.errors.items()],
    )
    if score.kitti is not None:
        translation, rotation = score.kitti.translation_percent, score.kitti.rotation_degpm
        say(f"KITTI drift {translation:.3f} % and {rotation:.5f} deg/m")
    for reason in score.skipped:
        say(f"not measured: {reason}")
