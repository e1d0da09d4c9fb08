"""What the demos' maps are judged by: truth, or measurements that a map was not made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.graph.cli.evaluate import compare
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.graph.unused_positions import unused_position_errors
from mapstream.recordings.evaluation import Statistics
from mapstream.recordings.maps import load_map

_V101_M = 2.771  # from the start of EuRoC V1_01's first 30 s to their end


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How far the map is from what it is judged by."""

    against: str
    distance_m: Statistics
    length_m: float


Judge = Callable[[Path, Path], Judgement]
"""Of the map's folder and the recording."""


def against_truth(folder: Path, truth: Path) -> Judgement:
    """Compare with the truth in a recording or a trajectory's file, after alignment."""
    score = compare(read_trajectory(folder), read_trajectory(truth), "se3")
    error = score.errors["absolute, translation [m]"]
    return Judgement(against="the truth", distance_m=error, length_m=score.length_m)


def against_unused_positions(folder: Path, recording: Path) -> Judgement:
    """Compare with positions in the recording that the map did not use."""
    found = unused_position_errors(load_map(folder), recording)
    against = f"{found.distance_m.count} GPS positions that were not used, {found.num_used} were"
    return Judgement(against=against, distance_m=found.distance_m, length_m=found.length_m)


def against_end_of_v101(folder: Path, recording: Path) -> Judgement:  # noqa: ARG001  # as others ask it
    """Compare how far the drive ends from its start: all of its truth that may be told here.

    EuRoC's truth is for research alone; gtsam's EqVIOFilterExample tells where it ends.
    """
    positions = read_trajectory(folder).poses[:, :3, 3]
    error_m = float(np.linalg.norm(positions[-1] - positions[0])) - _V101_M
    against = (
        f"the true distance from start to end, {_V101_M} m (for the way between them give --truth: "
        "EuRoC V1_01_easy's state_groundtruth_estimate0/data.csv)"
    )
    length_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return Judgement(
        against=against, distance_m=Statistics.of(np.array([error_m])), length_m=length_m
    )
