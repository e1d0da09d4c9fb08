"""What is known of a room's walls, in the world W-RGBD: planes fitted to points with 2 cm of noise."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from mapstream.operators.estimation.factors import planes
from mapstream.recordings.maps.model import Map
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.surfaces import Surface
from mapstream.recordings.worlds.w_rgbd import (
    START_NS,
    T_BASE_CAMERA,
    RgbdWorld,
    WRgbdConfig,
    rgbd_world,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from tests.operators.estimation.problems import (
    STEP_NS,
    Solved,
    cov,
    disturbed,
    with_constraints,
    with_edge,
    with_landmark,
    with_mission,
    with_relative,
)

SIGMA_M = 0.02  # of every point
NUM_POSES, NUM_POINTS = 10, 60  # of these many a plane is fitted
TIGHT = cov(1e-4, 1e-4)


@cache
def world() -> RgbdWorld:
    camera = {"width_px": 80, "height_px": 60}
    return rgbd_world(WRgbdConfig.model_validate({"camera": camera, "texel_m": 0.05}), 0)


def truth() -> FloatArray:
    """Return poses of the base on its way round the room."""
    stamps = START_NS + np.linspace(3, 39, NUM_POSES) * 1e9
    return orbit(40.0, START_NS).poses(stamps.astype(np.int64))


def is_large(surface: Surface) -> bool:
    return float(surface.size_m.min()) > 0.7


def fitted(points: FloatArray) -> tuple[SE3, FloatArray]:
    """Return a pose on the plane through points (N, 3), x along their longest side; and its covariance."""
    middle = points.mean(axis=0)
    _, lengths, axes = np.linalg.svd(points - middle, full_matrices=False)
    R = axes.T * [1, 1, np.sign(np.linalg.det(axes))]
    rotation = SIGMA_M / lengths[[1, 0]]  # about x the points lean by their spread along y
    distance = SIGMA_M / np.sqrt(len(points))
    inf = np.inf
    variances = np.array([*rotation**2, inf, inf, inf, distance**2])
    return SE3.from_rotation(R, middle), np.diag(variances)


def seen(pose: FloatArray, rng: np.random.Generator) -> dict[int, FloatArray]:
    """Return noisy points (N, 3) in the base frame, by the row of their surface."""
    view = world().camera.ideal(pose @ T_BASE_CAMERA.matrix)
    focal, center = 80 * 525 / 640, np.array([39.5, 29.5])
    found = {}
    for row in np.unique(view.surfaces):
        y, x = np.nonzero(view.surfaces == row)
        if row < 0 or not is_large(world().room.surfaces[row]) or len(x) < 3 * NUM_POINTS:
            continue
        some = rng.choice(len(x), NUM_POINTS, replace=False)
        px = np.stack([x[some], y[some]], axis=1)
        depth_m = 1 / view.inverse_depths[y[some], x[some]]
        in_camera = np.column_stack([(px - center) / focal, np.ones(NUM_POINTS)]) * depth_m[:, None]
        found[int(row)] = T_BASE_CAMERA @ in_camera + rng.normal(0, SIGMA_M, (NUM_POINTS, 3))
    return found


def room(seed: int) -> tuple[Map, list[int]]:
    """Return a map of poses and planes that wait to be solved, and the surface of each landmark."""
    rng = np.random.default_rng(seed)
    poses, names, made = truth(), [], []
    for at, pose in enumerate(poses):
        for row, points in seen(pose, rng).items():
            if row not in names:
                names.append(row)
            place, covariance = fitted(points)
            made.append(
                Constraint(
                    stamp_ns=1 + at * STEP_NS,
                    kind="plane",
                    T_a_b=place,
                    covariance=covariance,
                    landmark=LandmarkRef(name=str(row), kind="plane"),
                )
            )
    pairs = [(a, a + 1) for a in range(NUM_POSES - 1)]
    map_ = with_relative(with_mission(poses), pairs, poses, cov(0.01, 0.03), rng=rng)
    return disturbed(with_constraints(map_, made), rng, 0.01, 0.05), names


def normals(map_: Map, rows: IntArray) -> FloatArray:
    return planes.coefficients(map_.T_map_landmark(rows))


def related(map_: Map, names: list[int]) -> tuple[Map, list[tuple[int, int]]]:
    """Return the map with all that is square or parallel in the room, and the pairs that are."""
    pairs = []
    for a, b in combinations(range(len(names)), 2):
        cosine = abs(
            world().room.surfaces[names[a]].normal @ world().room.surfaces[names[b]].normal
        )
        if 1e-9 < cosine < 1 - 1e-9:
            continue
        kind = "parallel" if cosine > 0.5 else "perpendicular"
        map_ = with_edge(map_, kind, landmark_a=a, landmark_b=b, covariance=TIGHT)
        pairs.append((a, b))
    return map_, pairs


def off_square_deg(map_: Map, pairs: list[tuple[int, int]]) -> FloatArray:
    """Return how far pairs of planes (N,) are from square or parallel."""
    n = normals(map_, np.arange(len(map_.landmarks)))[:, :3]
    cosines = np.abs([n[a] @ n[b] for a, b in pairs])
    angles = np.arccos(np.clip(cosines, 0, 1))
    return np.asarray(np.degrees(np.minimum(angles, np.pi / 2 - angles)))


@pytest.mark.parametrize("seed", range(3))
def test_F14_square_and_parallel_planes_of_a_room(seed: int) -> None:
    """Within 0.1 degrees, and the planes' own angles are better by 30 % and more."""
    map_, names = room(seed)
    tied, pairs = related(map_, names)

    free, solved = Solved(map_), Solved(tied)

    assert {world().room.surfaces[row].name for row in names} >= {"table", "floor", "wall_north"}
    assert off_square_deg(solved.map, pairs).max() < 0.1
    true = np.stack([world().room.surfaces[row].normal for row in names])
    errors_deg = [angles_deg(each.map, true) for each in (free, solved)]
    assert rms(errors_deg[1]) < 0.7 * rms(errors_deg[0])  # 0.3 to 0.5 when this was written


def angles_deg(map_: Map, true_normals: FloatArray) -> FloatArray:
    """Return how far the first planes (N,) are turned from their true normals (N, 3)."""
    found = normals(map_, np.arange(len(true_normals)))[:, :3]
    cosines = np.abs((found * true_normals).sum(axis=1))
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, 0, 1))))


def rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.mark.parametrize("seed", range(3))
def test_F14_points_on_the_table_and_a_wall_seen_as_two(seed: int) -> None:
    """Points within a millimetre of their plane; two planes that are one within a millimetre and 0.1 degrees."""
    rng = np.random.default_rng(seed + 10)
    map_, names = room(seed)
    surfaces, poses = world().room.surfaces, truth()
    table = next(at for at, row in enumerate(names) if surfaces[row].name == "table")
    wall = next(at for at, row in enumerate(names) if surfaces[row].name.startswith("wall"))
    points = surfaces[names[table]].points(np.array([[0.1, 0.1], [1.2, 0.2], [0.7, 0.7]]))
    for place in points:
        map_ = with_landmark(map_, "point", SE3.from_rotation(np.eye(3), place).matrix)
        row = len(map_.landmarks) - 1
        for vertex in range(0, NUM_POSES, 2):
            measured = SE3(poses[vertex]).inverse() @ place + rng.normal(0, SIGMA_M, 3)
            map_ = with_edge(
                map_,
                "landmark",
                vertex_a=vertex,
                landmark_a=row,
                T_a_b=SE3.from_rotation(np.eye(3), measured).matrix,
                covariance=cov(np.inf, SIGMA_M),
            )
        map_ = with_edge(map_, "point_on_plane", landmark_a=row, landmark_b=table, covariance=TIGHT)
    second = len(map_.landmarks)
    fits = []
    for vertex, pose in enumerate(poses):
        for row, of_surface in seen(pose, rng).items():
            if row == names[wall]:
                fits.append((vertex, *fitted(of_surface[: NUM_POINTS // 3])))
    map_ = with_landmark(map_, "plane", (SE3(poses[fits[0][0]]) @ fits[0][1]).matrix)
    for vertex, place, covariance in fits:
        map_ = with_edge(
            map_,
            "plane",
            vertex_a=vertex,
            landmark_a=second,
            T_a_b=place.matrix,
            covariance=covariance,
        )
    map_ = with_edge(map_, "coplanar", landmark_a=wall, landmark_b=second, covariance=TIGHT)

    solved = Solved(map_).map

    found = normals(solved, np.array([table, wall, second]))
    at = solved.T_map_landmark(np.arange(len(names), len(names) + len(points)))[:, :3, 3]
    assert np.abs(at @ found[0, :3] + found[0, 3]).max() < 1e-3
    one, two = found[1], found[2] * np.sign(found[1, :3] @ found[2, :3])
    assert np.degrees(np.arccos(min(1.0, float(one[:3] @ two[:3])))) < 0.1
    assert abs(one[3] - two[3]) < 1e-3
