"""Walks whose objects were seen twice, with odometry that drifts, closed by their objects alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.maps.relax import relax_map
from mapstream.operators.objects.landmarks.object_landmarks import (
    ObjectLandmarksConfig,
    object_landmarks,
)
from mapstream.operators.objects.loops.candidates import DriftGate
from mapstream.operators.objects.loops.closing import SemanticLoopsConfig, close_semantic_loops
from mapstream.operators.objects.loops.edges import SOURCE
from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.recordings.evaluation import ape
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.pose_pairs import associate
from mapstream.recordings.worlds.sensors import drifting_odometry
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, se3_log
from mapstream.streams.messages.estimates import Keyframe, Odometry, RelativePose, Submap
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.trajectory import Trajectory

MISSION = "0f" * 16
AFTER_LOOPS = DriftGate(
    distance_m=1.0, distance_m_per_m=0, turn_rad=0.15, turn_rad_per_m=0, tilt_rad_per_m=0
)
"""By how much poses may be off once a first loop is closed."""


@dataclass(frozen=True)
class Walk:
    """What was seen from where, at moments that are worth a vertex."""

    poses: FloatArray  # (V, 4, 4) true, of the base
    seen: list[ObjectDetections]  # V, tracked

    @property
    def way_m(self) -> float:
        steps = np.diff(self.poses[:, :3, 3], axis=0)
        return float(np.linalg.norm(steps, axis=1).sum())


def drifted(walk: Walk, seed: int, end_m: float, stretch: float = 0.03) -> FloatArray:
    """Return the poses of a walk (V, 4, 4) as odometry has them that drifts until the end is off so far.

    It stretches the way by a part, and turns by a random walk and a constant rate.
    """
    stamps_ns = np.array([seen.stamp_ns for seen in walk.seen])

    def made(turn_radpm: float) -> FloatArray:
        rng = np.random.default_rng(seed)
        odometry = drifting_odometry(walk.poses, stamps_ns, stretch, rng, turn_radpm=turn_radpm)
        return np.array([each.T_odom_base.matrix for each in odometry])

    def off_m(turn_radpm: float) -> float:
        return float(np.linalg.norm(made(turn_radpm)[-1, :3, 3] - walk.poses[-1, :3, 3]))

    sign = 1.0 if seed % 2 else -1.0
    least, most = 0.0, 0.05
    for _ in range(20):
        middle = (least + most) / 2
        least, most = (middle, most) if off_m(sign * middle) < end_m else (least, middle)
    return made(sign * most)


def drifted_map(walk: Walk, seed: int, end_m: float, stretch: float = 0.03) -> Map:
    """Return a map of the walk as odometry that drifts has it; its edges say how much it may."""
    features = ObjectFeatures(ObjectFeaturesConfig())
    keyframes = [
        Keyframe(
            stamp_ns=seen.stamp_ns,
            odometry=Odometry(stamp_ns=seen.stamp_ns, T_odom_base=SE3(pose)),
            features=(features.features(seen),),
        )
        for pose, seen in zip(drifted(walk, seed, end_m, stretch), walk.seen, strict=True)
    ]
    edges = [_step(a, b) for a, b in pairwise(keyframes)]
    submap = Submap(mission_id=MISSION, index=0, keyframes=tuple(keyframes), edges=tuple(edges))
    return append_submap(Map.empty(), submap)


def _step(a: Keyframe, b: Keyframe) -> RelativePose:
    T_a_b = a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base
    sigmas = np.array(
        [0.01, 0.01, 0.05, 0.02, 0.02, 0.02]
    )  # for each root of a metre; it drifts about z most
    return RelativePose(
        kind="odometry",
        mission_a=MISSION,
        stamp_a_ns=a.stamp_ns,
        mission_b=MISSION,
        stamp_b_ns=b.stamp_ns,
        T_a_b=T_a_b,
        covariance=np.diag(sigmas**2) * (float(np.linalg.norm(T_a_b.t)) + 0.001),
    )


def closed(map_: Map, *, rounds: int = 2, gap_s: float = 10.0) -> Map:
    """Return the map after its semantic loops were closed, and again with the better poses, and relaxed."""
    for turn in range(rounds):
        gate = AFTER_LOOPS if turn else DriftGate()
        map_, _ = object_landmarks(map_, ObjectLandmarksConfig(max_gap_s=gap_s))
        map_, _ = close_semantic_loops(map_, SemanticLoopsConfig(gate=gate, min_gap_s=gap_s))
        map_, _ = relax_map(map_)
    return map_


def adjusted(map_: Map) -> Map:
    """Return the map after objects seen again became one, and bundle adjustment by all that see them; twice.

    With the better poses more is one, and where the middle of an object is in its box is better known.
    The middle of what is seen of an object is nearer than its own, so 3D points take no part.
    """
    config = OptimizeConfig(without=("points",), losses={"keypoints": "cauchy"})
    for _ in range(2):
        map_, _ = object_landmarks(map_)
        map_, _ = optimize_map(map_, config)
    return map_


@dataclass(frozen=True)
class Judged:
    """How far a map is from the truth."""

    end_m: float  # where the walk ends, from where it begins
    ape_m: float  # root mean square after alignment
    num_edges: int  # of semantic loops
    worst_edge_m: float
    worst_edge_rad: float


def judged(map_: Map, walk: Walk) -> Judged:
    """Compare a map with the truth."""
    T, true = map_.vertices.T_mission_base, walk.poses
    end = true[0] @ invert(T[0]) @ T[-1]
    stamps_ns = map_.vertices.stamp_ns
    estimate, truth = (Trajectory(stamps_ns=stamps_ns, poses=poses) for poses in (T, true))
    rows = np.flatnonzero(map_.edges.source == SOURCE)
    a, b = map_.edges.vertex_a[rows], map_.edges.vertex_b[rows]
    off = invert(invert(true[a]) @ true[b]) @ map_.edges.T_a_b[rows]
    return Judged(
        end_m=float(np.linalg.norm(end[:3, 3] - true[-1, :3, 3])),
        ape_m=ape(associate(estimate, truth)).translation.rmse,
        num_edges=len(rows),
        worst_edge_m=float(np.linalg.norm(off[:, :3, 3], axis=1).max(initial=0)),
        worst_edge_rad=float(np.linalg.norm(se3_log(off)[:, :3], axis=1).max(initial=0)),
    )
