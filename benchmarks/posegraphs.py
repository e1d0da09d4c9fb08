"""Public pose graphs: the optimum that is reached, and the time against gtsam's own Levenberg-Marquardt.

`python benchmarks/posegraphs.py FOLDER` reads the g2o files, and `.labels` of those with false loops.
Both sides begin with the map's tables and the same poses, and end with poses as arrays.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import gtsam
import numpy as np
import scipy.sparse.linalg
import scipy.special  # noqa: F401  # both imported when first needed: not what is measured here

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.outliers.scores import read_labels, score_loops
from mapstream.operators.estimation.problem import make_problem
from mapstream.operators.estimation.report import OptimizationReport
from mapstream.operators.estimation.starts.start import chordal_values
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray

REFERENCE = {  # 0.5 chi2 of the optimum
    "tinyGrid3D": 9.313904,
    "smallGrid3D": 517.9253,
    "parking-garage": 0.634192,
    "sphere2500": 675.7010,
    "MIT": 20.60347,
    "CSAIL": 20.27544,
    "intel": 22.50212,
    "manhattan": 1774.521,
    "kitti_00": 49.16107,
    "city10000": 255.9937,
}
SPOILED = (
    "intel_out100",
    "intel_out500",
    "sphere2500_out200",
    "sphere2500_out1000",
    "manhattan_out200",
    "manhattan_out2000",
)
ROUNDS = 3  # of which the fastest counts


def gtsam_alone(map_: Map, start: FloatArray) -> tuple[float, float]:
    """Return seconds of gtsam from tables to poses, and of its optimiser in it."""
    started = time.perf_counter()
    edges = map_.edges
    rows = np.flatnonzero(edges.vertex_b >= 0)
    roots = np.swapaxes(np.linalg.cholesky(np.linalg.inv(edges.covariance[rows])), 1, 2)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    ends = zip(edges.vertex_a[rows].tolist(), edges.vertex_b[rows].tolist(), strict=True)
    for (a, b), T, root in zip(ends, edges.T_a_b[rows], roots, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)  # noqa: FBT003  # smart=False
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T), noise))
    for key, pose in enumerate(start):
        values.insert(key, gtsam.Pose3(pose))
    exactly = gtsam.noiseModel.Constrained.All(6)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(start[0]), exactly))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    solving = time.perf_counter()
    solved = optimizer.optimize()
    ended = time.perf_counter()
    gtsam.utilities.extractPose3(solved)
    return time.perf_counter() - started, ended - solving


def ours(map_: Map, config: OptimizeConfig) -> tuple[float, OptimizationReport]:
    """Return the seconds of `optimize_map`, and its report."""
    started = time.perf_counter()
    _, report = optimize_map(map_, config)
    return time.perf_counter() - started, report


def start_of(map_: Map, start: str) -> FloatArray:
    """Return the poses (N, 4, 4) that an optimisation began with."""
    if start == "current":
        return map_.T_map_base(np.arange(len(map_.vertices)))
    problem = make_problem(map_, OptimizeConfig())
    values = chordal_values(problem, np.fromiter(problem.loops, dtype=np.int64))
    return np.array([values.atPose3(key).matrix() for key in range(len(map_.vertices))])


def clean(folder: Path) -> list[str]:
    """Return the rows of graphs without false loops."""
    lines = [
        "| graph | 0.5 chi2 | reference | off by | iterations | start | mapstream | whole gtsam | ratio | its optimiser alone |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, reference in REFERENCE.items():
        map_ = read_g2o(folder / f"{name}.g2o", are_loops_switchable=True)
        whole = min((ours(map_, OptimizeConfig()) for _ in range(ROUNDS)), key=lambda each: each[0])
        start = start_of(map_, whole[1].start)
        same = OptimizeConfig(start=whole[1].start)  # type: ignore[arg-type]  # current or chordal
        mine_s, report = min((ours(map_, same) for _ in range(ROUNDS)), key=lambda each: each[0])
        other_s, solver_s = min(gtsam_alone(map_, start) for _ in range(ROUNDS))
        lines.append(
            f"| {name} | {whole[1].error_after:.6g} | {reference:.6g} | {whole[1].error_after / reference - 1:.1e} |"
            f" {report.iterations} | {whole[1].start} | {mine_s:.3f} s, auto {whole[0]:.3f} s |"
            f" {other_s:.3f} s | {mine_s / other_s:.2f} | {solver_s:.3f} s |"
        )
    return lines


def spoiled(folder: Path) -> list[str]:
    """Return the rows of graphs with false loops."""
    lines = [
        "| graph | from the clean optimum, rms | precision | recall | false kept | true dropped | time |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in SPOILED:
        best, _ = optimize_map(read_g2o(folder / f"{name.split('_', 1)[0]}.g2o"))
        map_ = read_g2o(folder / f"{name}.g2o", are_loops_switchable=True)
        started = time.perf_counter()
        result, _ = optimize_map(map_)
        seconds = time.perf_counter() - started
        rows = np.arange(len(best.vertices))
        apart = (result.T_map_base(rows) - best.T_map_base(rows))[:, :3, 3]
        score = score_loops(result, read_labels(folder / f"{name}.g2o.labels"))
        lines.append(
            f"| {name} | {np.sqrt((apart**2).sum(axis=1).mean()):.4f} m | {score.precision:.4f} |"
            f" {score.recall:.4f} | {score.num_false_kept} of {score.num_false} |"
            f" {score.num_true_dropped} | {seconds:.2f} s |"
        )
    return lines


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    print("\n".join([*clean(folder), "", *spoiled(folder)]))
