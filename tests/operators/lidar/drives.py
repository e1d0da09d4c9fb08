"""Stored maps of a hall, with the clouds of their keyframes: truth is known, and odometry drifts."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import CLOUDS
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, se3_log
from mapstream.streams.messages.estimates import (
    Keyframe,
    Odometry,
    PointCloud,
    RelativePose,
    Submap,
)
from tests.operators.scenes import room, seen_from

Sights = Callable[[SE3, int], npt.NDArray[np.floating]]  # points seen from a pose, with a seed
MISSION, OTHER_MISSION = "0" * 31 + "1", "0" * 31 + "2"
SECOND_NS = 10**9
HALL = room(5, num_points=8000)
DRIFT = SE3.exp([0, 0, 0.005, 0.01, 0.01, 0.02])  # in each step
_SIGMAS = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])


def circle(num: int = 16, radius_m: float = 2.0) -> list[SE3]:
    """Return poses on a circle in the hall; the last one is where the first was."""
    turn = 2 * np.pi / (num - 1)
    step = SE3.exp([0, 0, turn, radius_m * turn, 0, 0])
    poses = [SE3.exp([0, 0, 0, 0, -radius_m, 0])]
    for _ in range(num - 1):
        poses.append(poses[-1] @ step)
    return poses


def submap_of(
    truth: Sequence[SE3],
    drift: SE3 = DRIFT,
    *,
    world: FloatArray | Sights = HALL,
    mission: str = MISSION,
    seed: int = 0,
) -> Submap:
    """Return a drive as one submap; its odometry begins at the truth, or at zero for another mission."""
    see = world if callable(world) else partial(seen_from, world)
    T_odom = truth[0] if mission == MISSION else SE3.identity()
    frames = []
    for k, T in enumerate(truth):
        if k:
            T_odom = T_odom @ truth[k - 1].inverse() @ T @ drift
        seen = see(T, seed + k).astype(np.float32)
        stamp_ns = k * SECOND_NS
        frames.append(
            Keyframe(
                stamp_ns=stamp_ns,
                odometry=Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom),
                cloud=PointCloud(stamp_ns=stamp_ns, points=seen),
            )
        )
    edges = [
        RelativePose(
            kind="odometry",
            mission_a=mission,
            stamp_a_ns=a.stamp_ns,
            mission_b=mission,
            stamp_b_ns=b.stamp_ns,
            T_a_b=a.odometry.T_odom_base.inverse() @ b.odometry.T_odom_base,
            covariance=np.diag(_SIGMAS**2),
        )
        for a, b in pairwise(frames)
    ]
    return Submap(mission_id=mission, index=0, keyframes=tuple(frames), edges=tuple(edges))


def stored(submap: Submap, folder: Path) -> Map:
    """Return the map of a submap whose clouds are now in a folder."""
    map_ = append_submap(Map.empty(), submap)
    rows = map_.vertex_rows(submap.mission_id, [f.stamp_ns for f in submap.keyframes])
    with CloudStore(folder / CLOUDS) as store:
        paths = []
        for frame in submap.keyframes:
            assert frame.cloud is not None
            key = cloud_key(submap.mission_id, frame.stamp_ns)
            store.put(key, frame.cloud)
            paths.append(f"{CLOUDS}/{key}.arrow")
    return add_resources(map_, vertex_rows=rows, kind="cloud", paths=paths)


def both(first: Map, second: Map) -> Map:
    """Return a map with the missions of two; where the second lies is not known."""
    return merge_maps([first, second])


def rms_m(map_: Map, truth: Sequence[SE3], mission: int = 0) -> float:
    """Return how far the vertices of a mission are from the truth, seen from the first."""
    poses = map_.vertices.T_mission_base[map_.vertices_of(mission)]
    true = np.array([T.matrix for T in truth])
    off = (invert(true[0]) @ true)[:, :3, 3] - (invert(poses[0]) @ poses)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def worst_edge_m(map_: Map, source: str, truths: Sequence[Sequence[SE3]]) -> float:
    """Return the largest error in position of the edges of a source; missions in the order of the map."""
    worst = 0.0
    for row in np.flatnonzero(map_.edges.source == source).tolist():
        a, b = (
            truths[int(map_.vertices.mission[v])][int(map_.vertices.stamp_ns[v]) // SECOND_NS]
            for v in (map_.edges.vertex_a[row], map_.edges.vertex_b[row])
        )
        error = invert((a.inverse() @ b).matrix) @ map_.edges.T_a_b[row]
        worst = max(worst, float(np.linalg.norm(se3_log(error[None])[0, 3:])))
    return worst
