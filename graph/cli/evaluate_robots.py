"""`mapstream eval MAP MISSION=PATH ...`: several robots at once, each with a reference of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.graph.cli.output import say, say_json, say_table
from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.operators.maps.missions import find_mission
from mapstream.recordings.joint_evaluation import JointErrors, joint_ape
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.store import MANIFEST
from mapstream.recordings.pose_pairs import AlignmentMode, PosePairs, associate
from mapstream.streams.errors import MapError
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairing:
    """How poses of an estimate find those of their reference."""

    topic: str | None
    max_difference_ns: int
    interpolate: bool

    def pairs(self, estimate: Trajectory, reference: Trajectory) -> PosePairs:
        return associate(
            estimate,
            reference,
            max_difference_ns=self.max_difference_ns,
            interpolate=self.interpolate,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Robot:
    """One mission of a map, and where its reference lies."""

    mission_id: str
    name: str
    map_folder: Path
    reference: Path
    reference_mission: str | None  # of a reference that is a map


def robots_of(estimate: Path, references: Sequence[str]) -> list[Robot] | None:
    """Return the robots of a map that have references; None where one trajectory is compared with one.

    Raises:
        MapError: If a reference names a mission that the map does not have, or none is in both maps.
    """
    named = [text.partition("=") for text in references]
    if not (estimate / MANIFEST).is_file():
        return None
    map_ = load_map(estimate, tables=["missions"])
    if all(equals for _, equals, _ in named):
        rows = [find_mission(map_, mission) for mission, _, _ in named]
        paths = [Path(path) for _, _, path in named]
        return [_robot(map_, estimate, *each, None) for each in zip(rows, paths, strict=True)]
    other = Path(references[0])
    if len(references) > 1 or len(map_.missions) < 2 or not (other / MANIFEST).is_file():
        return None
    return _common_robots(map_, estimate, other)


def _common_robots(map_: Map, folder: Path, other: Path) -> list[Robot]:
    reference = load_map(other, tables=["missions"])
    there = {reference.mission_id(row) for row in range(len(reference.missions))}
    ids = [map_.mission_id(row) for row in range(len(map_.missions))]
    robots = [
        _robot(map_, folder, row, other, mission_id)
        for row, mission_id in enumerate(ids)
        if mission_id in there
    ]
    if not robots:
        raise MapError(f"{folder} and {other} have no mission in common")
    return robots


def _robot(map_: Map, folder: Path, row: int, path: Path, mission: str | None) -> Robot:
    return Robot(
        mission_id=map_.mission_id(row),
        name=map_.missions.name[row],
        map_folder=folder,
        reference=path,
        reference_mission=mission,
    )


def evaluate_robots(
    robots: Sequence[Robot], pairing: Pairing, mode: AlignmentMode, *, json: bool
) -> None:
    """Print the errors of robots after one alignment for all, and after one for each."""
    pairs = {robot.mission_id: _pairs(robot, pairing) for robot in robots}
    found = joint_ape(pairs, mode)
    if json:
        say_json(_as_json(found))
        return
    say(
        f"{len(robots)} robots, {sum(map(len, pairs.values()))} poses, one alignment {mode} for all"
    )
    columns = ("rmse", "mean", "median", "std", "min", "max")
    joint = {"translation [m]": found.translation, "rotation [deg]": found.rotation_deg}
    say_table(
        ("error", *columns),
        [(name, *(getattr(s, c) for c in columns)) for name, s in joint.items()],
    )
    say_table(
        ("robot", "name", "poses", "rmse m", "max m", "rmse m, own alignment"),
        [
            (
                robot.mission_id[:8],
                robot.name,
                len(pairs[robot.mission_id]),
                errors.joint.translation.rmse,
                errors.joint.translation.max,
                errors.own.translation.rmse if errors.own else np.nan,
            )
            for robot, errors in zip(robots, found.robots.values(), strict=True)
        ],
    )


def _pairs(robot: Robot, pairing: Pairing) -> PosePairs:
    return pairing.pairs(
        read_trajectory(robot.map_folder, mission=robot.mission_id),
        read_trajectory(robot.reference, topic=pairing.topic, mission=robot.reference_mission),
    )


def _as_json(found: JointErrors) -> dict[str, object]:
    return {
        "translation": found.translation,
        "rotation_deg": found.rotation_deg,
        "alignment": found.alignment,
        "robots": {
            name: {
                "translation": errors.joint.translation,
                "own_translation": errors.own.translation if errors.own else None,
            }
            for name, errors in found.robots.items()
        },
    }
