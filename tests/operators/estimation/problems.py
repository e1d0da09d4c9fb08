"""Small problems made by hand: maps of a few poses with measurements of any kind, their truth, and their solution."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any  # gtsam has no types

import gtsam
import numpy as np

from mapstream.operators.estimation.fixing import fixed, fixes
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.estimation.priors import prior_factors
from mapstream.operators.estimation.states import initial_values, with_solution
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.constraints import add_constraints
from mapstream.recordings.maps.ids import derived_id, id_array, id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges, Landmarks, Vertices
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.constraints import Constraint

MISSION = "0f" * 16
STEP_NS = 500_000_000


def cov(sigma_rad: float, sigma_m: float) -> FloatArray:
    return np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)


def wander(num: int, rng: np.random.Generator) -> FloatArray:
    """Poses (N, 4, 4) that turn and climb."""
    poses = [np.eye(4)]
    for _ in range(num - 1):
        step = [*rng.normal(0, 0.25, 3), 1.0, *rng.normal(0, 0.3, 2)]
        poses.append(poses[-1] @ se3_exp(step))
    return np.array(poses)


def with_mission(
    poses: FloatArray,
    map_: Map | None = None,
    *,
    mission: str = MISSION,
    sensors: dict[str, Any] | None = None,
    step_ns: int = STEP_NS,
) -> Map:
    """Return a map with a vertex at each pose."""
    map_ = new_mission(map_ or Map.empty(), mission, sensors=json.dumps(sensors or {}))
    stamps = [1 + step_ns * at for at in range(len(poses))]
    vertices = Vertices(
        id=id_array(vertex_id(id_bytes(mission), stamp) for stamp in stamps),
        mission=np.full(len(poses), len(map_.missions) - 1),
        stamp_ns=np.array(stamps, np.int64),
        T_mission_base=poses,
    )
    return replace(map_, vertices=concatenate([map_.vertices, vertices]))


def with_constraints(map_: Map, constraints: Sequence[Constraint], mission: str = MISSION) -> Map:
    return add_constraints(map_, mission, constraints)


def with_relative(
    map_: Map,
    pairs: Iterable[tuple[int, int]],
    truth: FloatArray,
    covariance: FloatArray,
    *,
    rng: np.random.Generator | None = None,
    kind: str = "odometry",
) -> Map:
    """Return the map with measured transforms between vertices; exact without a generator."""
    a, b = np.array(list(pairs)).T
    measured = np.linalg.inv(truth[a]) @ truth[b]
    if rng is not None:
        sigma = np.sqrt(np.where(np.isfinite(covariance), covariance, 0).diagonal())
        measured = measured @ se3_exp(rng.normal(size=(len(a), 6)) * sigma)
    edges = Edges(
        kind=np.full(len(a), kind, dtype=object),
        vertex_a=a,
        vertex_b=b,
        T_a_b=measured,
        covariance=np.tile(covariance, (len(a), 1, 1)),
    )
    return append_edges(map_, edges)


def with_landmark(map_: Map, kind: str, place: FloatArray, vertex: int = 0) -> Map:
    """Return the map with one more landmark at a pose (4, 4) in the map frame."""
    in_base = SE3(np.linalg.inv(map_.T_map_base(np.array([vertex]))[0]) @ place)
    added = Landmarks(
        id=id_array([derived_id("landmark", len(map_.landmarks))]),
        kind=np.array([kind], dtype=object),
        vertex=np.array([vertex]),
        p_base=in_base.t[None],
        quat_base_xyzw=in_base.quat_xyzw[None],
    )
    return replace(map_, landmarks=concatenate([map_.landmarks, added]))


def with_edge(map_: Map, kind: str, **columns: Any) -> Map:  # noqa: ANN401
    """Return the map with one edge; numbers and matrices of its columns."""
    payload = json.dumps(columns.pop("payload", {})).encode()
    made = {name: np.asarray(value)[None] for name, value in columns.items()}
    kinds, payloads = np.array([kind], dtype=object), np.array([payload], dtype=object)
    return append_edges(map_, Edges(kind=kinds, payload=payloads, **made))


def disturbed(map_: Map, rng: np.random.Generator, sigma_rad: float, sigma_m: float) -> Map:
    """Return the map with all poses but the first moved at random."""
    poses = map_.vertices.T_mission_base
    moves = rng.normal(size=(len(poses), 6)) * np.repeat([sigma_rad, sigma_m], 3)
    moves[0] = 0
    return replace(map_, vertices=replace(map_.vertices, T_mission_base=poses @ se3_exp(moves)))


class Solved:
    """A map's problem, solved by Levenberg-Marquardt; `hold` are vertices that stay."""

    def __init__(
        self, map_: Map, *, hold: Iterable[int] = (0,), fixed_keys: Iterable[int] = ()
    ) -> None:
        self.factors = factors_of(map_)
        priors = prior_factors(map_, self.factors)
        keys = {key for factor in self.factors.values() for key in factor.keys()}  # noqa: SIM118
        self.start = initial_values(map_, keys)
        self.graph = gtsam.NonlinearFactorGraph()
        poses = map_.T_map_base(np.arange(len(map_.vertices)))
        for factor in (
            *self.factors.values(),
            *priors.values(),
            *(fixed(vertex, poses[vertex]) for vertex in hold),
            *fixes(map_, self.start, fixed_keys),
        ):
            self.graph.add(factor)
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(1e-14)
        params.setAbsoluteErrorTol(1e-14)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph, self.start, params)
        self.values = optimizer.optimize()
        self.iterations = optimizer.iterations()
        self.map = with_solution(map_, self.values, held=set(fixed_keys))

    @property
    def chi2(self) -> float:
        return 2 * sum(float(factor.error(self.values)) for factor in self.factors.values())

    def covariance(self, vertex: int) -> FloatArray:
        marginals = gtsam.Marginals(self.graph, self.values)
        found: FloatArray = marginals.marginalCovariance(key_of("pose", vertex))
        return found


def factors_of(map_: Map) -> dict[int, Factor]:
    return make_factors(map_, np.arange(len(map_.edges)), NoiseModels())


def position_errors_m(map_: Map, truth: FloatArray) -> FloatArray:
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    return np.asarray(np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1))


def angle_errors_deg(map_: Map, truth: FloatArray) -> FloatArray:
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    turns = np.swapaxes(poses[:, :3, :3], 1, 2) @ truth[:, :3, :3]
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosines, -1, 1))))


def jacobian_error(factor: Factor, values: Any, step: float = 1e-5) -> float:  # noqa: ANN401
    """Return how far the factor's own Jacobian is from central differences, by its largest entry."""
    linear = factor.linearize(values)
    analytic, _ = linear.jacobian()
    columns = []
    for key in linear.keys():  # noqa: SIM118
        size = values.zeroVectors().at(key).size
        for axis in range(size):
            ends = [_moved(values, key, axis, sign * step) for sign in (1, -1)]
            up, down = (factor.whitenedError(end) for end in ends)
            columns.append((up - down) / (2 * step))
    numeric = np.array(columns).T
    return float(np.abs(numeric - analytic).max() / max(np.abs(analytic).max(), 1.0))


def _moved(values: Any, key: int, axis: int, step: float) -> Any:  # noqa: ANN401
    delta = values.zeroVectors()
    moved = gtsam.VectorValues()
    for other in values.keys():  # noqa: SIM118
        vector = np.zeros(delta.at(other).size)
        if other == key:
            vector[axis] = step
        moved.insert(other, vector)
    return values.retract(moved)
