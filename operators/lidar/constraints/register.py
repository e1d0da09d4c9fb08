"""The registration module: keyframe clouds aligned to each other become loop edges that may be switched off.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D. An edge whose alignment contradicts the rest is
switched off by the optimizer; the next call takes it out, and tries again from the better poses.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.lidar.aligning import AligningConfig
from mapstream.operators.lidar.constraints.candidates import CandidatesConfig, Pair, candidates
from mapstream.operators.lidar.constraints.covariances import fixed_covariance
from mapstream.operators.lidar.constraints.keyframe_clouds import KeyframeClouds
from mapstream.operators.lidar.loop_matcher import Gate
from mapstream.operators.lidar.registration import RegistrationResult
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert

SOURCE = "registration"
ACCEPTED = "accepted"


class RegisterConfig(CandidatesConfig, AligningConfig):
    """Which keyframes are registered, how, and what is believed."""

    neighbours: NonNegativeInt = 2
    """Keyframes on either side whose clouds are merged."""
    accept_m: PositiveFloat = 0.5
    """How far an alignment may lie from the poses known before."""
    accept_deg: PositiveFloat = 10.0
    """How far it may turn away from them."""
    min_inlier_fraction: PositiveFloat = 0.6
    """Of the points, for an alignment to be believed."""
    max_rmse_m: PositiveFloat = 0.06
    """Of the inliers, for an alignment to be believed."""
    max_sigma_m: PositiveFloat = 0.3
    """How uncertain the position may be by the alignment itself: along a bare corridor nothing holds it."""
    covariance: Literal["fixed", "hessian"] = "fixed"
    """`fixed`: from a table, by sensor and method; `hessian`: what the alignment claims."""
    sensor: str = "lidar"
    """As the table calls what made the clouds."""
    covariances: Path | None = None
    """A table of fixed covariances, YAML; null: the one that comes with mapstream."""
    recompute_below: float = Field(default=0.5, ge=0.0, le=1.0)
    """Edges of an earlier call whose switch is below it are taken out and tried again."""
    again: bool = False
    """All edges of an earlier call are taken out and tried again, since poses are better now."""
    max_cloud_bytes: PositiveInt = 128_000_000
    """Memory for clouds; all of them are on disk."""

    def predefined_covariance(self) -> FloatArray | None:
        """Return the covariance (6, 6) of all edges, None where each alignment tells its own.

        Raises:
            ConfigError: If the table has none for this sensor and method.
        """
        if self.covariance == "hessian":
            return None
        return fixed_covariance(self.sensor, self.registration, self.covariances)


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredPair:
    """Two keyframes that were aligned, and whether that is believed."""

    mission_a: str
    stamp_a_ns: int
    mission_b: str
    stamp_b_ns: int
    relation: str
    distance_m: float  # by the poses known before
    verdict: str  # "accepted", or the reason
    shift_m: float = float("nan")  # of the alignment, from the poses known before
    turn_deg: float = float("nan")
    inlier_fraction: float = float("nan")
    rmse_m: float = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterReport:
    """What was tried, and what came of it."""

    num_tried: int
    num_added: int  # edges
    num_kept: int  # edges of an earlier call
    num_removed: (
        int  # edges of an earlier call that were tried again, or are no candidates any more
    )
    added: dict[str, int]  # by relation
    refused: dict[str, int]  # by the reason
    pairs: list[RegisteredPair]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        by_relation = ", ".join(f"{num} {what}" for what, num in self.added.items()) or "none"
        return [
            f"{self.num_added} of {self.num_tried} pairs registered: {by_relation}",
            f"{self.num_kept} edges kept, {self.num_removed} taken out",
            *(f"refused: {num}: {reason}" for reason, num in self.refused.items()),
        ]


def register(
    map_: Map,
    config: RegisterConfig | None = None,
    folder: Path | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[Map, RegisterReport]:
    """Return the map with its near keyframes registered to each other, and what became of each pair.

    Args:
        map_: The map; its poses say where to look and where alignments begin.
        config: See there.
        folder: Where its clouds are.
        on_progress: Takes the fraction that is done.

    Raises:
        MapError: If a cloud is not there or damaged.
        ConfigError: If there is no such registration, or no covariance for it.
    """
    config = config or RegisterConfig()
    own = np.flatnonzero(map_.edges.source == SOURCE)
    goes: BoolArray = np.zeros(len(map_.edges), bool)
    goes[own] = config.again | (map_.edges.switch[own] < config.recompute_below)
    map_ = map_.select(edges=~goes)
    clouds = KeyframeClouds(map_, folder, config.max_cloud_bytes)
    done = _done(map_)
    tried = [
        pair
        for pair in candidates(map_, clouds.vertices, config)
        if (pair.vertex_a, pair.vertex_b) not in done
    ]
    aligner = _Aligner(map_, clouds, config)
    edges, pairs = list[Edges](), list[RegisteredPair]()
    for n, pair in enumerate(tried):
        edge, told = aligner.align(pair)
        edges += edge
        pairs.append(told)
        if on_progress is not None:
            on_progress((n + 1) / len(tried))
    report = RegisterReport(
        num_tried=len(tried),
        num_added=len(edges),
        num_kept=len(own) - int(goes.sum()),
        num_removed=int(goes.sum()),
        added=_counted(pair.relation for pair in pairs if pair.verdict == ACCEPTED),
        refused=counted_verdicts(pair.verdict for pair in pairs),
        pairs=pairs,
    )
    return append_edges(map_, concatenate(edges)) if edges else map_, report


def _done(map_: Map) -> set[tuple[int, int]]:
    """Return the vertices that edges of an earlier call join."""
    rows = np.flatnonzero(map_.edges.source == SOURCE)
    return set(
        zip(map_.edges.vertex_a[rows].tolist(), map_.edges.vertex_b[rows].tolist(), strict=True)
    )


class _Aligner:
    """Aligns pairs of keyframes, from where the graph has them."""

    def __init__(self, map_: Map, clouds: KeyframeClouds, config: RegisterConfig) -> None:
        self._map, self._clouds, self._config = map_, clouds, config
        self._registration = config.make_registration()
        self._covariance = config.predefined_covariance()
        self._gate = Gate(
            min_inlier_fraction=config.min_inlier_fraction,
            max_rmse_m=config.max_rmse_m,
            max_turn_rad=float(np.radians(config.accept_deg)),
            max_sigma_m=config.max_sigma_m,
        )

    def align(self, pair: Pair) -> tuple[list[Edges], RegisteredPair]:
        """Return the edge of a pair, none where the alignment is not believed, and what to tell of it."""
        a, b = pair.vertex_a, pair.vertex_b
        T_map_a, T_map_b = self._map.T_map_base(np.array([a, b]))
        T_guess = SE3(invert(T_map_a) @ T_map_b)
        told = self._told(pair, float(np.linalg.norm(T_guess.t)))
        target, source = self._clouds.of_pair(a, b, self._config.neighbours)
        try:
            result = self._registration.align(source, target, T_guess)
        except EstimationError as error:
            return [], replace(told, verdict=str(error))
        refusal = self._gate.refusal(result, T_guess, self._config.accept_m)
        moved = T_guess.inverse() @ result.T_target_source
        told = replace(
            told,
            verdict=refusal or ACCEPTED,
            shift_m=float(np.linalg.norm(moved.t)),
            turn_deg=float(np.rad2deg(moved.angle_rad)),
            inlier_fraction=result.inlier_fraction,
            rmse_m=result.rmse_m,
        )
        return ([] if refusal else [self._edge(pair, result)]), told

    def _told(self, pair: Pair, distance_m: float) -> RegisteredPair:
        vertices, a, b = self._map.vertices, pair.vertex_a, pair.vertex_b
        return RegisteredPair(
            mission_a=self._map.mission_id(int(vertices.mission[a])),
            stamp_a_ns=int(vertices.stamp_ns[a]),
            mission_b=self._map.mission_id(int(vertices.mission[b])),
            stamp_b_ns=int(vertices.stamp_ns[b]),
            relation=pair.relation,
            distance_m=distance_m,
            verdict="",
        )

    def _edge(self, pair: Pair, result: RegistrationResult) -> Edges:
        covariance = result.covariance if self._covariance is None else self._covariance
        return loop_edge(pair.vertex_a, pair.vertex_b, result.T_target_source, covariance, SOURCE)


def loop_edge(a: int, b: int, T_a_b: SE3, covariance: FloatArray, source: str) -> Edges:
    """Return a loop edge between two vertices that an optimizer may switch off."""
    return Edges(
        kind=np.array(["loop"], dtype=object),
        vertex_a=np.array([a]),
        vertex_b=np.array([b]),
        T_a_b=T_a_b.matrix[None],
        covariance=covariance[None],
        is_switchable=np.array([True]),
        source=np.array([source], dtype=object),
    )


def _counted(words: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(words).items()))


def counted_verdicts(verdicts: Iterable[str]) -> dict[str, int]:
    """Return how often there is each reason, with N for its figures."""
    return _counted(re.sub(r"-?\b\d[\d.]*", "N", each) for each in verdicts if each != ACCEPTED)
