"""Where a robot is in a room whose planes are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.planes.localize_planes import LocalizePlanes, LocalizePlanesConfig
from mapstream.operators.planes.plane_pose import PlaneNoise, PlaneSet, pose_from_planes
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.build import new_mission
from mapstream.recordings.maps.constraints import add_constraints
from mapstream.recordings.maps.hulls import hull_payload
from mapstream.recordings.maps.ids import id_array, id_bytes, vertex_id
from mapstream.recordings.maps.tables import Vertices
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, se3_exp, so3_exp
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.planes import PlaneSegments
from tests.operators.estimation.problems import MISSION

pytestmark = pytest.mark.anyio

SECOND_NS = 10**9
COVARIANCE = np.diag([1e-4, 1e-4, np.inf, np.inf, np.inf, 1e-4])


def plane(
    normal: tuple[int, int, int], middle: tuple[float, float, float], size: tuple[float, float]
) -> tuple[SE3, FloatArray]:
    """A rectangle; its x is level, its size that along x and y."""
    z = np.array(normal, dtype=np.float64)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[2]) > 0.5 else [0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    half = np.array(size) / 2
    hull = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return SE3.from_rotation(np.column_stack([x, np.cross(z, x), z]), middle), hull


ROOM = {  # 5 m x 4 m x 2.6 m with a cupboard in one corner and a table at one wall: it looks alike from nowhere
    "floor": plane((0, 0, 1), (2.5, 2.0, 0.0), (5.0, 4.0)),
    "west": plane((1, 0, 0), (0.0, 2.0, 1.3), (4.0, 2.6)),
    "east": plane((-1, 0, 0), (5.0, 2.0, 1.3), (4.0, 2.6)),
    "south": plane((0, 1, 0), (2.5, 0.0, 1.3), (5.0, 2.6)),
    "north": plane((0, -1, 0), (2.5, 4.0, 1.3), (5.0, 2.6)),
    "cupboard_front": plane((0, -1, 0), (0.5, 3.4, 1.0), (1.0, 2.0)),
    "cupboard_side": plane((1, 0, 0), (1.0, 3.7, 1.0), (0.6, 2.0)),
    "table": plane((0, 0, 1), (4.4, 1.5, 0.7), (1.2, 0.8)),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    vertices = Vertices(
        id=id_array([vertex_id(id_bytes(MISSION), 1)]),
        mission=np.zeros(1, np.int64),
        stamp_ns=np.array([1]),
        T_mission_base=np.eye(4)[None],
    )
    map_ = replace(new_mission(Map.empty(), MISSION), vertices=vertices)
    seen = [
        Constraint(
            stamp_ns=1,
            kind="plane",
            T_a_b=T,
            covariance=COVARIANCE,
            landmark=LandmarkRef(name=name, kind="plane"),
            payload=hull_payload(hull),
        )
        for name, (T, hull) in ROOM.items()
    ]
    save_map(add_constraints(map_, MISSION, seen), tmp_path / "map")
    return tmp_path / "map"


def at(x: float, y: float, heading: float) -> SE3:
    return SE3.from_rotation(so3_exp([0, 0, heading]), [x, y, 1.2])


def view(
    pose: SE3, at_s: float, rng: np.random.Generator, *, ahead_only: bool = True
) -> PlaneSegments:
    """What lies before the robot and faces it, with noise of 0.2 deg and 5 mm."""
    poses, hulls = [], []
    for T, hull in ROOM.values():
        T_base_plane = pose.inverse() @ T
        if (pose.t - T.t) @ T.R[:, 2] > 0.1 and (T_base_plane.t[0] > 0.3 or not ahead_only):
            noise = [*rng.normal(0, 0.003, 2), 0, 0, 0, rng.normal(0, 0.005)]
            poses.append((T_base_plane @ SE3.exp(noise)).matrix)
            hulls.append(0.9 * hull)
    n = len(poses)
    return PlaneSegments(
        stamp_ns=round(at_s * SECOND_NS),
        T_base_plane=np.array(poses).reshape(-1, 4, 4),
        covariances=np.tile(COVARIANCE, (n, 1, 1)),
        hulls_m=tuple(hulls),
        num_points=np.full(n, 20_000),
        rmse_m=np.zeros(n),
    )


async def located(
    folder: Path, way: list[SE3], odometry: list[SE3], step_s: float = 0.5
) -> list[MapPose]:
    rng = np.random.default_rng(4)
    config = LocalizePlanesConfig(map=folder)
    out = await run_operator(
        LocalizePlanes(config),
        planes=[view(pose, step_s * k, rng) for k, pose in enumerate(way)],
        odometry=[
            Odometry(stamp_ns=round(step_s * k * SECOND_NS), T_odom_base=pose)
            for k, pose in enumerate(odometry)
        ],
    )
    poses: list[MapPose] = out["poses"]
    return poses


def off(pose: MapPose, truth: SE3) -> tuple[float, float]:
    assert pose.T_map_base is not None
    error = truth.inverse() @ pose.T_map_base
    return float(np.linalg.norm(error.t)), float(np.rad2deg(error.angle_rad))


@pytest.mark.slow
async def test_U1_planes_alone_find_a_robot_anywhere_in_the_room_and_hold_it(folder: Path) -> None:
    """It turns on its way; odometry begins elsewhere and drifts by 2 cm a step."""
    way = [at(1.5 + 0.15 * k, 1.2 + 0.05 * k, 0.9 + 0.25 * k) for k in range(12)]
    start = SE3(se3_exp([0.0, 0.0, 1.0, 7.0, -3.0, 0.4]))
    odometry = [
        start @ way[0].inverse() @ pose @ SE3.from_rotation(np.eye(3), [0.02 * k, 0, 0])
        for k, pose in enumerate(way)
    ]

    poses = await located(folder, way, odometry)

    states = [pose.state for pose in poses]
    first = states.index("tracking")
    assert first <= 5  # 2.5 s
    assert set(states[first:]) == {"tracking"}
    errors = np.array([off(pose, way[k]) for k, pose in enumerate(poses) if k >= first])
    assert errors[:, 0].max() < 0.1
    assert errors[:, 1].max() < 1.0


@pytest.mark.slow
async def test_U1_a_robot_that_was_carried_elsewhere_is_found_by_planes(folder: Path) -> None:
    """Its odometry noticed nothing: lost within a second, recovered within five."""
    first = [at(1.5, 1.5, 0.6)] * 5
    second = [at(3.5, 2.6, 2.6)] * 13
    way = first + second

    poses = await located(folder, way, [SE3.identity()] * len(way))

    states = [pose.state for pose in poses]
    assert states[4] == "tracking"
    back = states.index("recovered")
    assert back - 5 <= 10
    assert "lost" in states[5:back]
    distance, angle = off(poses[-1], way[-1])
    assert distance < 0.1
    assert angle < 1.0


@pytest.mark.slow
async def test_U1_a_place_that_looks_alike_is_not_taken(folder: Path) -> None:
    """In the middle of an empty hall, seen from both ends, nobody knows which end it is."""
    rng = np.random.default_rng(2)
    empty = ["floor", "west", "east", "south", "north"]
    pose = at(2.5, 2.0, 0.3)
    whole = view(pose, 0.0, rng, ahead_only=False)
    chosen = [at for at, name in enumerate(ROOM) if name in empty][: len(whole)]
    few = [
        PlaneSegments(
            stamp_ns=k * SECOND_NS,
            T_base_plane=whole.T_base_plane[chosen],
            covariances=whole.covariances[chosen],
            hulls_m=tuple(whole.hulls_m[row] for row in chosen),
            num_points=whole.num_points[chosen],
            rmse_m=whole.rmse_m[chosen],
        )
        for k in range(4)
    ]

    config = LocalizePlanesConfig(map=folder)
    out = await run_operator(
        LocalizePlanes(config),
        planes=few,
        odometry=[Odometry(stamp_ns=k * SECOND_NS, T_odom_base=SE3.identity()) for k in range(5)],
    )

    assert {pose.state for pose in out["poses"]} == {"lost"}
    assert any("look alike" in pose.verdict for pose in out["poses"])


def test_three_planes_fix_a_pose_and_one_leaves_three_directions_open() -> None:
    known = PlaneSet(
        np.array([T.R[:, 2] for T, _ in ROOM.values()]), np.array([T.t for T, _ in ROOM.values()])
    )
    truth = SE3(se3_exp([0.1, 0.2, -0.3, 1.0, 2.0, 0.5]))
    seen = PlaneSet(known.normals @ truth.R, (known.points - truth.t) @ truth.R)
    noise = PlaneNoise(sigma_rad=0.01, sigma_m=0.02)
    start = truth @ SE3.exp([0.05, -0.05, 0.05, 0.2, 0.1, -0.1])

    three = np.array([0, 1, 3])
    T, information = pose_from_planes(known.chosen(three), seen.chosen(three), start, noise)
    one = np.array([0])
    _, of_one = pose_from_planes(known.chosen(one), seen.chosen(one), start, noise)

    np.testing.assert_allclose(T.matrix, truth.matrix, atol=1e-8)
    assert np.linalg.matrix_rank(information) == 6
    assert np.linalg.matrix_rank(of_one) == 3


async def test_a_map_without_planes_is_refused(tmp_path: Path) -> None:
    save_map(new_mission(Map.empty(), MISSION), tmp_path / "map")

    with pytest.raises(MapError, match="no planes with outlines"):
        await run_operator(
            LocalizePlanes(LocalizePlanesConfig(map=tmp_path / "map")), planes=[], odometry=[]
        )
