"""The optimizer against gtsam alone: the same problem, incrementally and in one batch."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any, Literal

import gtsam
import numpy as np
import scipy.sparse.csgraph  # noqa: F401  # imported when first needed: not what is measured here

from benchmarks.table import Row, markdown
from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap

NUM_POSES, SUBMAP, LAP, LOOP_EVERY = 10_000, 10, 500, 100
SIGMAS = np.array([0.001, 0.001, 0.001, 0.02, 0.02, 0.02])
MISSION = "ab" * 16


def _drive(rng: np.random.Generator) -> tuple[list[Submap], list[RelativePose]]:
    """Return twenty laps as submaps with noisy odometry, and loops on the lap before, one in 100 poses."""
    angles = 2 * np.pi * np.arange(NUM_POSES + 1) / LAP
    radius = SE3.from_rotation(np.eye(3), [100.0, 0, 0])
    truth = [SE3.exp([0, 0, angle, 0, 0, 0]) @ radius for angle in angles]

    def noisy(a: SE3, b: SE3) -> SE3:
        return a.inverse() @ b @ SE3(se3_exp(rng.normal(size=6) * SIGMAS))

    def edge(kind: Literal["odometry", "loop"], a: int, b: int, T_a_b: SE3) -> RelativePose:
        return RelativePose(
            kind=kind, mission_a=MISSION, stamp_a_ns=a, mission_b=MISSION, stamp_b_ns=b,
            T_a_b=T_a_b, covariance=np.diag(SIGMAS**2), is_switchable=kind == "loop",
        )  # fmt: skip

    steps = [noisy(a, b) for a, b in pairwise(truth)]
    poses = [truth[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    frames = [
        Keyframe(stamp_ns=i, odometry=Odometry(stamp_ns=i, T_odom_base=p))
        for i, p in enumerate(poses)
    ]
    edges = [edge("odometry", i, i + 1, step) for i, step in enumerate(steps)]
    submaps = [
        Submap(
            mission_id=MISSION,
            index=i // SUBMAP,
            keyframes=tuple(frames[i : i + SUBMAP + 1]),
            edges=tuple(edges[i : i + SUBMAP]),
        )
        for i in range(0, NUM_POSES, SUBMAP)
    ]
    loops = [
        edge("loop", b - LAP, b, noisy(truth[b - LAP], truth[b]))
        for b in range(LAP, NUM_POSES, LOOP_EVERY)
    ]
    return submaps, loops


def _closing(submap: Submap, loops: list[RelativePose]) -> list[RelativePose]:
    first, last = submap.keyframes[0].stamp_ns, submap.keyframes[-1].stamp_ns
    return [loop for loop in loops if first < loop.stamp_b_ns <= last]


def _incremental(
    submaps: list[Submap], loops: list[RelativePose]
) -> tuple[list[float], list[float]]:
    """Return the times [ms] of adding each submap, and of closing each loop."""
    live = LiveMap(OptimizeConfig())
    plain_ms, loop_ms = [], []
    for submap in submaps:
        started = time.perf_counter()
        live.append(submap)
        plain_ms.append(1e3 * (time.perf_counter() - started))
        closing = _closing(submap, loops)
        if closing:
            started = time.perf_counter()
            live.close_loops(closing)
            loop_ms.append(1e3 * (time.perf_counter() - started))
    return plain_ms, loop_ms


def _gtsam_alone(submaps: list[Submap], loops: list[RelativePose]) -> list[float]:
    """Return the times [ms] of adding each submap to iSAM2, and of asking it for all poses."""
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.01)
    params.relinearizeSkip = 1
    isam, noise = gtsam.ISAM2(params), gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    plain_ms = []
    for submap in submaps:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        edges = list(submap.edges)
        new = submap.keyframes[submap.index > 0 :]
        if submap.index == 0:
            held = gtsam.noiseModel.Constrained.All(6)
            graph.add(gtsam.PriorFactorPose3(0, _pose(new[0].odometry.T_odom_base), held))
        for keyframe in new:
            values.insert(keyframe.stamp_ns, _pose(keyframe.odometry.T_odom_base))
        for edge in edges:
            graph.add(_between(edge, noise))
        started = time.perf_counter()
        isam.update(graph, values)
        gtsam.utilities.extractPose3(isam.calculateEstimate())
        plain_ms.append(1e3 * (time.perf_counter() - started))
        for loop in _closing(submap, loops):
            graph = gtsam.NonlinearFactorGraph()
            graph.add(_between(loop, noise))
            isam.update(graph, gtsam.Values())
    return plain_ms


def _pose(T: SE3) -> Any:  # noqa: ANN401  # gtsam's
    return gtsam.Pose3(T.matrix)


def _between(edge: RelativePose, noise: Any) -> Any:  # noqa: ANN401  # gtsam's
    return gtsam.BetweenFactorPose3(edge.stamp_a_ns, edge.stamp_b_ns, _pose(edge.T_a_b), noise)


def _batch(submaps: list[Submap], loops: list[RelativePose]) -> tuple[float, float, float]:
    """Return seconds of ours, of gtsam alone on the same problem, and the ratio of the errors."""
    map_ = Map.empty()
    for submap in submaps:
        map_ = append_submap(map_, submap)
    map_ = add_edges(map_, loops)
    started = time.perf_counter()
    _, report = optimize_map(map_, OptimizeConfig(is_robust=False))
    ours_s = time.perf_counter() - started
    edges, poses = map_.edges, map_.T_map_base(np.arange(len(map_.vertices)))
    started = time.perf_counter()
    noise, graph, values = (
        gtsam.noiseModel.Diagonal.Sigmas(SIGMAS),
        gtsam.NonlinearFactorGraph(),
        gtsam.Values(),
    )
    for a, b, T_a_b in zip(
        edges.vertex_a.tolist(), edges.vertex_b.tolist(), edges.T_a_b, strict=True
    ):
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), noise))
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), gtsam.noiseModel.Constrained.All(6)))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    other_s = time.perf_counter() - started
    return ours_s, other_s, report.error_after / graph.error(solved)


def run() -> list[Row]:
    """Measure on twenty laps of 500 poses."""
    submaps, loops = _drive(np.random.default_rng(0))
    plain_ms, loop_ms = _incremental(submaps, loops)
    alone_ms = _gtsam_alone(submaps, loops)
    rows = [
        _added(num_poses, plain_ms, alone_ms, "at most 50 ms" if num_poses == 5000 else "")
        for num_poses in (5000, NUM_POSES)
    ]
    ours_s, other_s, error = _batch(submaps, loops)
    last_ms = float(np.percentile(loop_ms[-20:], 95))
    return [
        *rows,
        Row(what=f"close a loop at {NUM_POSES} poses, p95", ours=f"{last_ms:.0f} ms", other="the batch below it", ratio=last_ms / 1e3 / other_s),
        Row(what=f"batch, {NUM_POSES} poses", ours=f"{ours_s:.2f} s", other=f"gtsam alone {other_s:.2f} s", ratio=ours_s / other_s, bar="at most 1.5"),
        Row(what="error it ends with", ours="", other="gtsam alone", ratio=error, bar="1"),
    ]  # fmt: skip


def _added(num_poses: int, plain_ms: list[float], alone_ms: list[float], bar: str) -> Row:
    """Return the 95th percentiles over the hundred submaps before so many poses."""
    upto = slice(num_poses // SUBMAP - 100, num_poses // SUBMAP)
    ours, alone = (float(np.percentile(each[upto], 95)) for each in (plain_ms, alone_ms))
    return Row(
        what=f"add a submap at {num_poses} poses, p95",
        ours=f"{ours:.1f} ms",
        other=f"gtsam alone {alone:.1f} ms",
        ratio=ours / alone,
        bar=bar,
    )


if __name__ == "__main__":
    print(markdown(run()))
