"""How often, and how well, a robot was found in a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.evaluation import Statistics
from mapstream.recordings.recording import open_recording
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert, so3_log
from mapstream.streams.messages.estimates import MapPose
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationScore:
    """What poses in a map are worth."""

    num_poses: int  # asked for
    num_found: int  # of these, where the robot was not lost
    states: dict[str, int]
    num_right: int = 0  # within the limits of the truth
    recall: float = float(
        "nan"
    )  # of the poses that were asked for, those that are right; NaN without truth
    precision: float = float("nan")  # of the poses that were found
    distance_m: Statistics | None = None  # of the poses that were found
    angle_deg: Statistics | None = None


def score_poses(
    poses: Sequence[MapPose],
    truth: Trajectory | None = None,
    *,
    max_distance_m: float = 0.25,
    max_angle_deg: float = 2.0,
) -> LocalizationScore:
    """Return how many poses were found, and how far they are from the truth.

    Args:
        poses: In the order of their stamps.
        truth: Poses of the base in the map's frame; poses outside its time do not count.
        max_distance_m: Of a pose that is right.
        max_angle_deg: The same of its direction.
    """
    if truth is not None:
        poses = [pose for pose in poses if truth.covers(pose.stamp_ns)]
    states: list[str] = [pose.state for pose in poses]
    found = [pose for pose in poses if pose.T_map_base is not None]
    counts = {state: states.count(state) for state in sorted(set(states))}
    if truth is None or not found:
        return LocalizationScore(
            num_poses=len(poses),
            num_found=len(found),
            states=counts,
            recall=float("nan") if truth is None or not poses else 0.0,
        )
    expected = truth.at(np.array([pose.stamp_ns for pose in found]))
    off = invert(expected) @ _matrices(found)
    distance_m = np.linalg.norm(off[:, :3, 3], axis=1)
    angle_deg = np.rad2deg(np.linalg.norm(so3_log(off[:, :3, :3]), axis=1))
    right = int(((distance_m <= max_distance_m) & (angle_deg <= max_angle_deg)).sum())
    return LocalizationScore(
        num_poses=len(poses),
        num_found=len(found),
        states=counts,
        num_right=right,
        recall=right / len(poses),
        precision=right / len(found),
        distance_m=Statistics.of(distance_m),
        angle_deg=Statistics.of(angle_deg),
    )


def read_map_poses(path: Path, topic: str) -> list[MapPose]:
    """Return the poses in a map that a recording holds."""
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel, MapPose)
        decoded = [decode(raw) for raw in recording.messages([topic])]
    return [message for message in decoded if isinstance(message, MapPose)]


def _matrices(poses: Sequence[MapPose]) -> FloatArray:
    matrices = [pose.T_map_base.matrix for pose in poses if pose.T_map_base is not None]
    return np.array(matrices).reshape(-1, 4, 4)
