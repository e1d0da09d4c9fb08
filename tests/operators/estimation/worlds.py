"""Pose graphs whose truth is known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap

MISSION = "0123456789abcdef" * 2
SIGMAS = np.array([0.001, 0.001, 0.001, 0.02, 0.02, 0.02])
COVARIANCE = np.diag(SIGMAS**2)


def circle(num_poses: int, *, laps: float = 2.0, radius_m: float = 20.0) -> list[SE3]:
    """Return poses on a circle, heading along it."""
    angles = np.linspace(0, 2 * np.pi * laps, num_poses, endpoint=False)
    turn = [SE3.exp([0, 0, angle, 0, 0, 0]) for angle in angles]
    start = SE3.from_rotation(np.eye(3), [radius_m, 0, 0])
    return [rotation @ start for rotation in turn]


def measured(T_a: SE3, T_b: SE3, rng: np.random.Generator) -> SE3:
    return T_a.inverse() @ T_b @ SE3(se3_exp(rng.normal(size=6) * SIGMAS))


def edge(
    a: int, b: int, T_a_b: SE3, *, kind: str = "odometry", mission: str = MISSION
) -> RelativePose:
    return RelativePose(
        kind=kind,  # type: ignore[arg-type]  # tests pass only kinds that exist
        mission_a=mission,
        stamp_a_ns=a,
        mission_b=mission,
        stamp_b_ns=b,
        T_a_b=T_a_b,
        covariance=COVARIANCE,
        source="test",
        is_switchable=kind == "loop",
    )


def submaps(truth: list[SE3], rng: np.random.Generator, *, size: int = 10) -> list[Submap]:
    """Return the drive as submaps with noisy odometry; stamps are 0, 1, 2 ... ns."""
    steps = [measured(a, b, rng) for a, b in pairwise(truth)]
    odometry = [truth[0]]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    frames = [
        Keyframe(stamp_ns=i, odometry=Odometry(stamp_ns=i, T_odom_base=pose))
        for i, pose in enumerate(odometry)
    ]
    edges = [edge(i, i + 1, step) for i, step in enumerate(steps)]
    starts = range(0, len(frames) - 1, size)
    return [
        Submap(
            mission_id=MISSION,
            index=k,
            keyframes=tuple(frames[i : i + size + 1]),
            edges=tuple(edges[i : i + size]),
        )
        for k, i in enumerate(starts)
    ]


def drive(num_poses: int, seed: int) -> tuple[Map, list[SE3], np.random.Generator]:
    """Return the map of a drive without loops, its true poses, and the generator that goes on."""
    rng = np.random.default_rng(seed)
    truth = circle(num_poses)
    map_ = Map.empty()
    for submap in submaps(truth, rng):
        map_ = append_submap(map_, submap)
    return map_, truth, rng


def loops(
    truth: list[SE3], rng: np.random.Generator, *, lap: int, every: int = 5
) -> list[RelativePose]:
    """Return true loops between a pose and the one a lap before."""
    found = range(lap, len(truth), every)
    return [edge(b - lap, b, measured(truth[b - lap], truth[b], rng), kind="loop") for b in found]


def false_loop(a: int, b: int, rng: np.random.Generator) -> RelativePose:
    return edge(a, b, SE3(se3_exp(rng.normal(size=6) * [0.1, 0.1, 2, 5, 5, 0.2])), kind="loop")


def rmse_m(poses: np.ndarray, truth: list[SE3]) -> float:
    """Return the position error without alignment: the first pose is given."""
    t = np.array([pose.t for pose in truth])
    return float(np.sqrt(((poses[:, :3, 3] - t) ** 2).sum(axis=1).mean()))
