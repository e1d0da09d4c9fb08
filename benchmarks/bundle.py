"""Bundle adjustment: time per iteration against gtsam alone, a factor object per observation, and against COLMAP's.

All three solve the same problem on one thread, in seconds of the processor since other work may share the machine: one camera without distortion, squared errors, the first two poses held.
COLMAP's solver (Ceres) runs where `pycolmap` is installed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import gtsam
import numpy as np

from benchmarks.table import Row, markdown
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.estimation.fixing import fixed
from mapstream.operators.estimation.problem import graph_of, make_problem
from mapstream.operators.estimation.solvers import Limits
from mapstream.operators.estimation.vision.bundle_solver import bundle_solver
from mapstream.recordings.maps.build import new_mission
from mapstream.recordings.maps.cameras import Camera, with_cameras
from mapstream.recordings.maps.ids import derived_id, id_array, id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Landmarks, Observations, Vertices
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3, invert, se3_exp

MISSION = "5a" * 16
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 450.0, 752, 480
ITERATIONS = 4
LANDMARK_KEY = (
    1_000_000  # gtsam's bulk call passes keys through floats, which symbols do not survive
)


@dataclass(frozen=True)
class Problem:
    """A camera that flies along a wall, and what it saw."""

    poses: FloatArray  # (V, 4, 4) of the camera, where the solvers begin
    points: FloatArray  # (L, 3)
    pose: IntArray  # (N,)
    point: IntArray  # (N,)
    px: FloatArray  # (N, 2)


def flight(num_poses: int, per_image: int, rng: np.random.Generator) -> Problem:
    """Return a problem whose points are seen by about ten images in a row."""
    truth = np.tile(np.eye(4), (num_poses, 1, 1))
    truth[:, 0, 3] = 0.5 * np.arange(num_poses)
    truth = truth @ se3_exp(rng.normal(0, 0.02, (num_poses, 6)))
    num = per_image * num_poses // 10
    points = rng.uniform([0, -2.2, 4], [0.5 * num_poses, 2.2, 6], (num, 3))
    T = invert(truth)
    parts = []
    for k in range(num_poses):
        near = np.flatnonzero(np.abs(points[:, 0] - truth[k, 0, 3]) < 6)
        p = points[near] @ T[k, :3, :3].T + T[k, :3, 3]
        px = FOCAL_PX * p[:, :2] / p[:, 2:] + [WIDTH_PX / 2, HEIGHT_PX / 2]
        is_seen = ((px > 0) & (px < [WIDTH_PX, HEIGHT_PX])).all(axis=1)
        parts.append((np.full(is_seen.sum(), k), near[is_seen], px[is_seen]))
    pose, point, px = (np.concatenate(each) for each in zip(*parts, strict=True))
    seen, point = np.unique(point, return_inverse=True)
    moved = truth @ se3_exp(rng.normal(0, 0.01, (num_poses, 6)))
    moved[:2] = truth[:2]
    return Problem(
        poses=moved,
        points=points[seen] + rng.normal(0, 0.05, (len(seen), 3)),
        pose=pose,
        point=point,
        px=px + rng.normal(0, 0.5, px.shape),
    )


def as_map(problem: Problem) -> Map:
    """Return the problem as a map, whose bases are the cameras."""
    map_ = new_mission(Map.empty(), MISSION)
    num = len(problem.poses)
    stamps = np.arange(num) * 100_000_000
    vertices = Vertices(
        id=id_array(vertex_id(id_bytes(MISSION), s) for s in stamps.tolist()),
        mission=np.zeros(num, np.int64),
        stamp_ns=stamps,
        T_mission_base=problem.poses,
    )
    home = np.zeros(len(problem.points), np.int64)
    home[problem.point[::-1]] = problem.pose[::-1]
    T = invert(problem.poses[home])
    landmarks = Landmarks(
        id=id_array(derived_id("landmark", k) for k in range(len(home))),
        kind=np.full(len(home), "brisk", object),
        vertex=home,
        p_base=np.einsum("nij,nj->ni", T[:, :3, :3], problem.points) + T[:, :3, 3],
    )
    seen = Observations(
        vertex=problem.pose,
        landmark=problem.point,
        sensor=np.full(len(problem.pose), "camera", object),
        kind=np.full(len(problem.pose), "brisk", object),
        keypoint_px=problem.px.astype(np.float32),
    )
    lens = CameraCalibration(
        width_px=WIDTH_PX, height_px=HEIGHT_PX, focal_px=np.full(2, FOCAL_PX),
        center_px=np.array([WIDTH_PX / 2, HEIGHT_PX / 2]), distortion_parameters=np.zeros(0),
    )  # fmt: skip
    map_ = Map(
        missions=map_.missions,
        vertices=concatenate([map_.vertices, vertices]),
        landmarks=landmarks,
        observations=seen,
    )
    return with_cameras(map_, 0, {"camera": Camera(calibration=lens, T_base_sensor=SE3.identity())})


def ours(problem: Problem) -> tuple[float, float, float]:
    """Return seconds of each iteration, seconds before the first, and the error at the end."""
    started = time.process_time()
    config = OptimizeConfig(losses={"keypoints": "squared"}, underconstrained="prior")
    made = make_problem(as_map(problem), config)
    graph = graph_of([fixed(k, problem.poses[k]) for k in range(2)])
    ready = time.process_time()
    solved = bundle_solver(made.bundle)(graph, made.values, Limits(max_iterations=ITERATIONS))
    ended = time.process_time()
    return (ended - ready) / solved.iterations, ready - started, solved.error


def gtsam_alone(problem: Problem) -> tuple[float, float, float]:
    """Return the same of gtsam's Levenberg-Marquardt, points first in its ordering."""
    started = time.process_time()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lens = gtsam.Cal3_S2(FOCAL_PX, FOCAL_PX, 0, WIDTH_PX / 2, HEIGHT_PX / 2)
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    ordering = gtsam.Ordering()
    for k, point in enumerate(problem.points):
        values.insertPoint3(LANDMARK_KEY + k, point)
        ordering.push_back(LANDMARK_KEY + k)
    for k, pose in enumerate(problem.poses):
        values.insert(k, gtsam.Pose3(pose))
        ordering.push_back(k)
    for pose, point, px in zip(
        problem.pose.tolist(), problem.point.tolist(), problem.px, strict=True
    ):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(px, noise, pose, LANDMARK_KEY + point, lens))
    for k in range(2):
        graph.add(fixed(k, problem.poses[k]))
    params = gtsam.LevenbergMarquardtParams()
    params.setOrdering(ordering)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    ready = time.process_time()
    for _ in range(ITERATIONS):
        optimizer.iterate()
    return (time.process_time() - ready) / ITERATIONS, ready - started, optimizer.error()


def colmap(problem: Problem) -> tuple[float, float, float]:
    """Return the same of COLMAP's bundle adjustment, on one thread."""
    import pycolmap  # noqa: PLC0415  # only where it is installed

    started = time.process_time()
    made = pycolmap.Reconstruction()
    lens = [FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2]
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH_PX, height=HEIGHT_PX, params=lens)
    )
    config = pycolmap.BundleAdjustmentConfig()
    config.set_constant_cam_intrinsics(1)
    order = np.argsort(problem.pose, kind="stable")
    cuts = np.searchsorted(problem.pose[order], np.arange(len(problem.poses) + 1))
    number = np.empty(len(order), np.int64)  # of each keypoint in its image
    for k, pose in enumerate(problem.poses):
        own = order[cuts[k] : cuts[k + 1]]
        number[own] = np.arange(len(own))
        image = pycolmap.Image(name=str(k), keypoints=problem.px[own], camera_id=1, image_id=k + 1)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(pose)[:3]))
        config.add_image(k + 1)
    for k in range(2):
        config.set_constant_rig_from_world_pose(made.image(k + 1).frame_id)
    by_point = np.argsort(problem.point, kind="stable")
    ends = np.searchsorted(problem.point[by_point], np.arange(len(problem.points) + 1))
    for k, point in enumerate(problem.points):
        track = pycolmap.Track()
        for row in by_point[ends[k] : ends[k + 1]].tolist():
            track.add_element(int(problem.pose[row]) + 1, int(number[row]))
        made.add_point3D(point, track)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.num_threads = ITERATIONS, 1
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, made)
    ready = time.process_time()
    summary: Any = adjuster.solve().ceres_summary
    seconds = time.process_time() - ready
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps
    return seconds / steps, ready - started, summary.final_cost


def run() -> list[Row]:
    """Measure on 200 images with 300 keypoints each, and COLMAP's where it is."""
    problem = flight(200, 300, np.random.default_rng(0))
    num = len(problem.pose)
    ours_s, ours_before_s, error = ours(problem)
    rows = []
    others = {"gtsam alone": gtsam_alone}
    if find_spec("pycolmap"):
        others["COLMAP"] = colmap
    for name, solve in others.items():
        other_s, other_before_s, other_error = solve(problem)
        rows += [
            Row(what=f"an iteration, {num} observations", ours=f"{1e3 * ours_s:.0f} ms", other=f"{name} {1e3 * other_s:.0f} ms", ratio=ours_s / other_s),
            Row(what="making the problem", ours=f"{ours_before_s:.2f} s", other=f"{name} {other_before_s:.2f} s", ratio=ours_before_s / other_before_s),
            Row(what="error it ends with", ours="", other=name, ratio=error / other_error, bar="1"),
        ]  # fmt: skip
    if "COLMAP" not in others:
        rows.append(Row(what="COLMAP", ours="", other="left out: pip install pycolmap", ratio=float("nan")))  # fmt: skip
    return rows


if __name__ == "__main__":
    print(markdown(run()))
