"""Fewer landmarks: the N that are most useful for localisation, so that every vertex keeps enough of them.

Source: Dymczyk et al., The gist of maps, ICRA 2015 (the integer programme with a slack for each vertex); maplab's
command landmark_sparsify (lsparsify).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from mapstream.operators.landmarks.removal import without_landmarks
from mapstream.operators.maps.naming import things
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import MapError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_ROUNDS = 20  # of the heuristic, between the first and the last landmark that goes
_MIP_GAP = 1e-3  # of the best score


class SparsifyConfig(OperatorConfig):
    """How many landmarks stay, and how they are chosen."""

    num_landmarks: PositiveInt | None = None
    share: float = Field(default=0.2, gt=0, le=1)
    """Of landmarks, where no number is given."""
    method: Literal["program", "heuristic", "random"] = "program"
    """program: the best by an integer programme; heuristic: the least useful go, some at a time."""
    min_per_vertex: NonNegativeInt = 30
    """Landmarks that every vertex keeps, if it has so many and the number allows it."""
    penalty: NonNegativeFloat = 5.0
    """Observations that a landmark which a vertex lacks is worth."""
    max_program: PositiveInt = 100_000
    """Landmarks of one programme; more are parted along the missions."""
    max_seconds: float = Field(default=120.0, gt=0)
    """Of one programme; the best so far counts."""
    seed: int = 1234


@dataclass(frozen=True, slots=True, kw_only=True)
class SparsifyReport:
    """What stayed."""

    num_before: int = 0  # landmarks with observations
    num_kept: int = 0
    num_parts: int = 0
    fewest_before: int = 0  # landmarks of the vertex that has fewest
    fewest_kept: int = 0
    num_short: int = 0  # vertices that have fewer than they should and could


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """Which vertices see which landmarks."""

    landmarks: IntArray  # (L,) rows, those with observations
    sees: csr_array  # (V, L) of ones
    score: FloatArray  # (L,) observations
    center: FloatArray  # (L,) the mean place of those who see it, along the missions
    needed: FloatArray  # (V,) landmarks that each vertex shall keep


def sparsify(map_: Map, config: SparsifyConfig | None = None) -> tuple[Map, SparsifyReport]:
    """Return the map with the most useful of its landmarks; things, and landmarks without observations, stay."""
    config = config or SparsifyConfig()
    sight = _sight(map_, config)
    num = len(sight.landmarks)
    if not num:
        return map_, SparsifyReport()
    wanted = min(config.num_landmarks or max(round(config.share * num), 1), num)
    parts = _parts(sight, config)
    kept = np.zeros(num, bool)
    shares = _shared(wanted, [len(part) for part in parts])
    for part, share in zip(parts, shares, strict=True):
        kept[part] = _chosen(_part(sight, part), share, config)
    goes = np.zeros(len(map_.landmarks), bool)
    goes[sight.landmarks[~kept]] = True
    left, _ = without_landmarks(map_, goes)
    before, after = sight.sees.sum(axis=1), sight.sees @ kept.astype(np.float64)
    has_any = before > 0
    return left, SparsifyReport(
        num_before=num,
        num_kept=int(kept.sum()),
        num_parts=len(parts),
        fewest_before=int(before[has_any].min()),
        fewest_kept=int(after[has_any].min()),
        num_short=int((after < sight.needed).sum()),
    )


def _sight(map_: Map, config: SparsifyConfig) -> _Sight:
    from scipy.sparse import csr_array  # noqa: PLC0415  # takes most of a second to import

    seen = map_.observations
    is_point = np.ones(len(map_.landmarks) + 1, bool)
    is_point[things(map_)] = is_point[-1] = False  # the last is that of no landmark
    rows = np.flatnonzero(is_point[seen.landmark])
    landmarks, column = np.unique(seen.landmark[rows], return_inverse=True)
    order = np.lexsort((map_.vertices.stamp_ns, map_.vertices.mission))
    place = np.empty(len(order))
    place[order] = np.arange(len(order))
    pairs = np.unique(np.stack([seen.vertex[rows], column]), axis=1)
    shape = (len(map_.vertices), len(landmarks))
    sees = csr_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=shape)
    score = np.bincount(column).astype(np.float64)
    center = np.bincount(column, weights=place[seen.vertex[rows]]) / score
    needed = np.minimum(sees.sum(axis=1), config.min_per_vertex)
    return _Sight(landmarks, sees, score, center, needed)


def _parts(sight: _Sight, config: SparsifyConfig) -> list[IntArray]:
    """Return landmarks in parts of like size that lie along the missions."""
    num = len(sight.landmarks)
    order = np.argsort(sight.center, kind="stable")
    is_program = config.method == "program"
    return list(np.array_split(order, -(-num // config.max_program) if is_program else 1))


def _shared(wanted: int, sizes: list[int]) -> list[int]:
    """Return how many of each part stay, so that all together are what is wanted."""
    ends = np.round(wanted * np.cumsum(sizes) / sum(sizes)).astype(np.int64)
    return [int(size) for size in np.diff(ends, prepend=0)]


def _part(sight: _Sight, part: IntArray) -> _Sight:
    """Return the sight of some landmarks; a vertex needs of them what is their share of all that it sees."""
    sees = sight.sees[:, part]
    total = np.maximum(sight.sees.sum(axis=1), 1)
    needed = np.floor(sight.needed * sees.sum(axis=1) / total + 1e-9)
    return _Sight(sight.landmarks[part], sees, sight.score[part], sight.center[part], needed)


def _chosen(sight: _Sight, wanted: int, config: SparsifyConfig) -> BoolArray:
    if config.method == "random":
        order = np.random.default_rng(config.seed).permutation(len(sight.landmarks))
        chosen = np.zeros(len(order), bool)
        chosen[order[:wanted]] = True
        return chosen
    if config.method == "heuristic":
        return _worn_down(sight, wanted, config)
    return _best(sight, wanted, config)


def _best(sight: _Sight, wanted: int, config: SparsifyConfig) -> BoolArray:
    """Return the landmarks with the most observations such that vertices have what they need, as far as may be.

    maximise score x - penalty * longest score * slack, with sum x = N and sees x + slack >= needed.

    Raises:
        MapError: If the programme ends without a solution.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp  # noqa: PLC0415
    from scipy.sparse import block_array, coo_array, eye_array  # noqa: PLC0415

    active = np.flatnonzero(sight.needed > 0)
    num, slacks = len(sight.landmarks), len(active)
    # A slack must cost more than any landmark is worth, or vertices with short tracks would lose all of theirs.
    cost = np.concatenate([-sight.score, np.full(slacks, config.penalty * sight.score.max())])
    count = coo_array(np.concatenate([np.ones(num), np.zeros(slacks)])[None])
    enough = block_array([[sight.sees[active], eye_array(slacks)]]) if slacks else None
    constraints = [LinearConstraint(count.tocsr(), wanted, wanted)]
    if enough is not None:
        constraints.append(LinearConstraint(enough.tocsr(), sight.needed[active], np.inf))
    upper = np.concatenate([np.ones(num), sight.needed[active]])
    solved = milp(
        cost,
        integrality=np.concatenate([np.ones(num), np.zeros(slacks)]),
        bounds=Bounds(0, upper),
        constraints=constraints,
        options={"mip_rel_gap": _MIP_GAP, "time_limit": config.max_seconds},
    )
    if solved.x is None:
        raise MapError(f"the choice of {wanted} of {num} landmarks: {solved.message}")
    chosen: BoolArray = solved.x[:num] > 0.5
    return chosen


def _worn_down(sight: _Sight, wanted: int, config: SparsifyConfig) -> BoolArray:
    """Return what is left if the least useful go, some at a time.

    A landmark is worth its observations, and more the fewer its vertices have (maplab: 5 times the square of
    what is missing).
    """
    chosen = np.ones(len(sight.landmarks), bool)
    by_landmark = sight.sees.T.tocsr()
    for left in np.linspace(len(chosen), wanted, _ROUNDS + 1).round().astype(np.int64)[1:]:
        have = sight.sees @ chosen.astype(np.float64)
        missing = np.maximum(sight.needed - have, 0)
        lacking = np.maximum(sight.needed - have + 1, 0)
        worth = sight.score + by_landmark @ (config.penalty * (lacking**2 - missing**2))
        order = np.argsort(np.where(chosen, worth, -np.inf), kind="stable")
        chosen = np.zeros(len(chosen), bool)
        chosen[order[len(order) - left :]] = True
    return chosen
