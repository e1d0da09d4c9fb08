"""The problem behind a map: its factors, its variables, and which edges may be switched."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from mapstream.operators.estimation.fixing import fixed_keys, fixes, half_fixes
from mapstream.operators.estimation.gauge import gauge_factors
from mapstream.operators.estimation.keys import variable_of
from mapstream.operators.estimation.kinds import make_factors, makers
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.estimation.optimize_config import Loss, OptimizeConfig
from mapstream.operators.estimation.outliers.consistency import chi2_gate
from mapstream.operators.estimation.priors import prior_factors
from mapstream.operators.estimation.solvers import Graph
from mapstream.operators.estimation.states import Values, initial_values
from mapstream.operators.estimation.vision.bundle import Bundle, make_bundle
from mapstream.operators.estimation.vision.camera_states import camera_priors
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_RELATIVE = ("odometry", "wheel", "registration", "motion_model", "loop")  # need no priors
_LOSSES: dict[str, str] = {
    "huber": "Huber",
    "cauchy": "Cauchy",
    "geman_mcclure": "GemanMcClure",
    "tukey": "Tukey",
}


_USUAL_WIDTHS: dict[str, float] = {  # 95 % efficient without outliers (Zhang, IVC 1997, table 1)
    "huber": 1.345,
    "cauchy": 2.385,
    "geman_mcclure": 1.345,
    "tukey": 4.685,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Factors by the rows of their edges; keys are those of `keys.py`."""

    map: Map
    plain: Mapping[int, Factor]  # of edges that are taken as true
    loops: Mapping[int, Factor]  # of edges that may be switched off
    held: list[Factor]  # what holds variables: the gauge, weak priors, and what the user fixed
    fixed: set[int]  # keys of variables that the user fixed
    values: Values  # the map's present state
    base_graph: Graph  # without edges that may be switched off
    freedom: int  # directions that were measured, less those that are unknown
    ignored: dict[str, int]  # edges that do not take part, by kind
    underconstrained: list[str]  # variables that a weak prior holds
    bundle: Bundle  # what sensors saw of points; may be empty

    @property
    def num_edges(self) -> dict[str, int]:
        """Edges that take part, by kind."""
        rows = [*self.plain, *self.loops]
        return dict(sorted(Counter(self.map.edges.kind[rows].tolist()).items()))

    def whole_graph(self) -> Graph:
        """Return the graph with every edge as it is."""
        return graph_of([*self.held, *self.plain.values(), *self.loops.values()])


def make_problem(map_: Map, config: OptimizeConfig) -> Problem:
    """Return the problem of a map.

    An edge that may not be switched counts by the square of the switch it has; with 0 it takes no part.

    Raises:
        EstimationError: If an edge is not what its kind needs.
    """
    edges = map_.edges
    takes_part = np.isin(edges.kind, list(makers())) & ~np.isin(edges.kind, config.without)
    if config.kinds is not None:
        takes_part &= np.isin(edges.kind, config.kinds)
    if config.unanchored == "apart":
        takes_part &= ~_leaves_the_known(map_)
    may_switch = edges.is_switchable & config.is_robust
    is_on = may_switch | (edges.switch > 0)
    factors = make_factors(map_, np.flatnonzero(takes_part & is_on), NoiseModels())
    for row in np.flatnonzero(~may_switch & (edges.switch > 0) & (edges.switch < 1)).tolist():
        if row in factors:
            factors[row] = weighted(factors[row], float(edges.switch[row] ** 2))
    for kind, loss in config.losses.items():
        if loss == "squared":
            continue
        for row in np.flatnonzero((edges.kind == kind) & ~may_switch).tolist():
            if row in factors:
                factors[row] = with_loss(factors[row], loss, config.loss_width)
    plain = {row: factor for row, factor in factors.items() if not may_switch[row]}
    other = {row: f for row, f in factors.items() if edges.kind[row] not in _RELATIVE}
    held = [*prior_factors(map_, other).values()]
    bundle = make_bundle(map_, config)
    if "poses" not in config.fix:
        held += gauge_factors(map_, factors, bundle.links)
    in_graph = graph_of([*held, *factors.values()]).keyVector()
    values = initial_values(map_, {*in_graph, *bundle.keys})
    held += camera_priors(values).values()
    fixed = fixed_keys(values.keys(), config.fix)
    alone = set(bundle.point_keys).difference(in_graph)  # the bundle itself holds these
    held += [*fixes(map_, values, fixed - alone), *half_fixes(values, config.fix)]
    num_residuals = bundle.num_residuals + sum(f.dim() for f in (*held, *factors.values()))
    return Problem(
        map=map_,
        plain=plain,
        loops={row: factor for row, factor in factors.items() if may_switch[row]},
        held=held,
        fixed=fixed,
        values=values,
        base_graph=graph_of([*held, *plain.values()]),
        freedom=num_residuals - int(values.dim()),
        ignored=dict(Counter(edges.kind[~takes_part].tolist())),
        underconstrained=[],
        bundle=bundle,
    )


def _leaves_the_known(map_: Map) -> BoolArray:
    """Return which edges (N,) lie between a mission whose base frame is known and one where it is not."""
    is_known = map_.missions.is_base_frame_known[map_.vertices.mission]
    a, b = map_.edges.vertex_a, map_.edges.vertex_b
    leaves: BoolArray = (a >= 0) & (b >= 0)
    leaves[leaves] = is_known[a[leaves]] != is_known[b[leaves]]
    return leaves


def graph_of(factors: list[Factor]) -> Graph:
    """Return gtsam's graph of these factors."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def weighted(factor: Factor, weight: float) -> Factor:
    """Return the factor with its chi2 times a weight."""
    root = np.sqrt(weight) * factor.noiseModel().R()
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.asfortranarray(root), False)  # noqa: FBT003
    return factor.cloneWithNewNoiseModel(noise)


def with_loss(factor: Factor, loss: Loss, width: float) -> Factor:
    """Return the factor under a robust loss, of its usual width times this one.

    The usual widths are standard deviations of one direction. Several directions together get the width that
    chance exceeds as rarely.
    """
    noise, usual = factor.noiseModel(), _USUAL_WIDTHS[loss]
    limit = width * float(np.sqrt(chi2_gate(noise.dim(), math.erf(usual / math.sqrt(2)))))
    estimator = getattr(gtsam.noiseModel.mEstimator, _LOSSES[loss]).Create(limit)
    return factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(estimator, noise))


def chi2_of(factors: Mapping[int, Factor], values: Values) -> FloatArray:
    """Return the squared weighted residual (N,) of each factor, in their order."""
    return np.array([2 * factor.error(values) for factor in factors.values()], dtype=np.float64)


def dimensions(factors: Mapping[int, Factor], map_: Map) -> IntArray:
    """Return how many directions (N,) each factor's edge measured."""
    rows = np.fromiter(factors, dtype=np.int64)
    is_measured = np.isfinite(np.diagonal(map_.edges.covariance[rows], axis1=1, axis2=2))
    directions: IntArray = np.maximum(is_measured.sum(axis=1), 1)
    return directions


def describe_failure(error: RuntimeError, map_: Map) -> str:
    """Return what gtsam could not solve, in terms of the map."""
    found = re.search(r"(?:variable|Symbol:|key)\D*(\d+)", str(error))
    if found is None:
        return f"the problem cannot be solved: {str(error).strip()}"
    return (
        f"{describe_variable(int(found[1]), map_)} is not determined by the edges;"
        " look for an edge without covariance in some direction, add an absolute edge,"
        " or set underconstrained: prior"
    )


def describe_variable(key: int, map_: Map) -> str:
    """Return what a variable is, for people."""
    variable, row = variable_of(key)
    if variable in ("landmark", "frame", "extrinsics", "camera", "intrinsics", "time_offset"):
        return f"the {variable} in row {row}"
    mission = map_.mission_id(int(map_.vertices.mission[row]))
    stamp_ns = int(map_.vertices.stamp_ns[row])
    return f"the {variable} at {stamp_ns} ns of mission {mission} (vertex {row})"
