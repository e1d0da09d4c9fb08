"""Visual loop closure of a map: places seen again become edges, or landmarks that are the same become one.

An edge has a covariance and a switch; merged landmarks let bundle adjustment weigh each observation by itself,
which is softer (Cramariuc et al., maplab 2.0, RA-L 2023, section III-C).
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.landmarks.merging import merge_landmarks
from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.recognition import Found
from mapstream.operators.places.roc import RocPoint, roc
from mapstream.operators.places.searching import Compared, SearchConfig, search
from mapstream.operators.places.views import VertexViews
from mapstream.operators.places.whole_images import WholeImages, WholeImagesConfig, whole_images
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert

SOURCE = "visual_loops"


class LoopEdgeConfig(OperatorConfig):
    """What an edge between two places is worth."""

    sigma_rotation_rad: PositiveFloat = 0.003
    """Uncertainty that every loop has beyond that of the keypoints, since landmarks are not exact."""
    sigma_translation_m: PositiveFloat = 0.02
    """The same of the position."""
    switch_variance: NonNegativeFloat = 1e-8
    """Of the switch by which an optimizer may turn the edge off."""

    def covariance(self, of_pose: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) of an edge."""
        sigmas = np.repeat([self.sigma_rotation_rad, self.sigma_translation_m], 3)
        covariance: FloatArray = of_pose + np.diag(sigmas**2)
        return covariance


class VisualLoopsConfig(SearchConfig):
    """How visual loops are found and what becomes of them."""

    result: Literal["edges", "merge"] = "edges"
    """`merge`: landmarks become one instead, where both missions are anchored; no edge is added."""
    edge: LoopEdgeConfig = Field(default_factory=LoopEdgeConfig)
    candidates: Literal["local", "global", "both"] = "local"
    """`local`: matches of keypoints vote for places. `global`: those whose recorded images are most alike as a
    whole are compared. `both`: these where the votes recognise nothing."""
    whole_images: WholeImagesConfig = Field(default_factory=WholeImagesConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedPlace:
    """A vertex (b) and a place from before (a), and why they are or are not the same."""

    mission_a: str
    stamp_a_ns: int
    mission_b: str
    stamp_b_ns: int
    distance_m: float  # by the poses of the map
    score: float
    num_votes: int
    num_matches: int
    num_inliers: int
    verdict: str  # "accepted", or the reason


@dataclass(frozen=True, slots=True, kw_only=True)
class VisualLoopsReport:
    """What was compared, and what came of it."""

    num_compared: int  # vertices
    num_accepted: int
    num_edges: int
    num_merged: int  # landmarks that are now part of another
    reasons: dict[str, int]  # why vertices were not recognised
    inliers_by_kind: dict[str, int]
    candidates: list[ComparedPlace]
    roc: list[RocPoint]  # of the score, by the verdict of the geometry

    def lines(self) -> list[str]:
        """Return what to tell people."""
        by_kind = ", ".join(f"{num} of {kind}" for kind, num in self.inliers_by_kind.items())
        return [
            f"{self.num_accepted} of {self.num_compared} vertices recognised; inliers: {by_kind or 'none'}",
            f"{self.num_edges} edges added, {self.num_merged} landmarks merged",
            *(f"not recognised: {num}: {reason}" for reason, num in self.reasons.items()),
        ]


def find_visual_loops(
    map_: Map, config: VisualLoopsConfig | None = None, images: WholeImages | None = None
) -> tuple[Map, VisualLoopsReport]:
    """Return the map with its visual loops closed, and what became of each candidate.

    Landmarks must be there: `create_landmarks` makes them from tracks.

    Args:
        map_: The map.
        config: How loops are found.
        images: What its images look like, for candidates that are not local; without, they are read again.

    Raises:
        MapError: If images are asked for and none lie behind the map.
    """
    config = config or VisualLoopsConfig()
    compared = _compared(map_, config, images)
    found = [(each.vertex, each.recognition.found) for each in compared]
    accepted = [(vertex, place) for vertex, place in found if place is not None]
    changed, num_merged, num_edges = map_, 0, 0
    if config.result == "edges":
        edges = [loop_edge(map_, vertex, place, config.edge) for vertex, place in accepted]
        changed = append_edges(map_, concatenate(edges)) if edges else map_
        num_edges = len(edges)
    else:
        changed, num_merged = _merged(map_, accepted, config.kinds)
    candidates = [place for each in compared for place in compared_places(map_, each)]
    reasons = Counter(
        _code(each.recognition.reason) for each in compared if each.recognition.found is None
    )
    kinds = Counter(
        map_.landmarks.kind[landmark]
        for _, place in accepted
        for landmark in place.inliers.landmark.tolist()
    )
    return changed, VisualLoopsReport(
        num_compared=len(compared),
        num_accepted=len(accepted),
        num_edges=num_edges,
        num_merged=num_merged,
        reasons=dict(sorted(reasons.items())),
        inliers_by_kind=dict(sorted(kinds.items())),
        candidates=candidates,
        roc=roc([c.score for c in candidates], [c.verdict == "accepted" for c in candidates]),
    )


def _compared(map_: Map, config: VisualLoopsConfig, images: WholeImages | None) -> list[Compared]:
    if config.candidates == "local":
        return list(search(map_, config))
    images = images or whole_images(map_, config.whole_images)
    propose = partial(images.most_alike, count=config.whole_images.num_vertices)
    return list(search(map_, config, propose, has_votes=config.candidates == "both"))


def loop_edge(map_: Map, vertex: int, place: Found, config: LoopEdgeConfig) -> Edges:
    """Return the edge from the place's vertex to the one that was recognised there."""
    T_map_a = map_.T_map_base(np.array([place.vertex]))
    pose = place.consensus.pose
    return Edges(
        kind=np.array(["loop"], dtype=object),
        vertex_a=np.array([place.vertex]),
        vertex_b=np.array([vertex]),
        T_a_b=invert(T_map_a) @ pose.T_map_base.matrix,
        covariance=config.covariance(pose.covariance)[None],
        is_switchable=np.array([True]),
        switch_variance=np.array([config.switch_variance]),
        source=np.array([SOURCE], dtype=object),
    )


def compared_places(map_: Map, compared: Compared) -> list[ComparedPlace]:
    """Return what became of each place that a vertex was compared with, by missions and stamps."""
    vertices, at = map_.vertices, compared.vertex
    t = map_.T_map_base(np.array([at, *(c.vertex for c in compared.recognition.candidates)]))
    distances_m = np.linalg.norm(t[1:, :3, 3] - t[0, :3, 3], axis=1)
    return [
        ComparedPlace(
            mission_a=map_.mission_id(int(vertices.mission[c.vertex])),
            stamp_a_ns=int(vertices.stamp_ns[c.vertex]),
            mission_b=map_.mission_id(int(vertices.mission[at])),
            stamp_b_ns=int(vertices.stamp_ns[at]),
            distance_m=distance_m,
            score=c.score,
            num_votes=c.num_votes,
            num_matches=c.num_matches,
            num_inliers=c.num_inliers,
            verdict=c.verdict,
        )
        for c, distance_m in zip(compared.recognition.candidates, distances_m.tolist(), strict=True)
    ]


def _merged(
    map_: Map, accepted: list[tuple[int, Found]], kinds: tuple[str, ...]
) -> tuple[Map, int]:
    """Return the map in which landmarks that were recognised are one, and how many went.

    Between missions only where both are anchored: elsewhere nothing says where the two lie to each other.
    """
    views, missions = VertexViews(map_, kinds), map_.vertices.mission
    is_known = map_.missions.is_base_frame_known
    pairs = [np.empty((0, 2), np.int64)]
    for vertex, place in accepted:
        a, b = missions[place.vertex], missions[vertex]
        if a != b and not (is_known[a] and is_known[b]):
            continue
        rows_of = [view.rows for view in views.at(vertex)]
        keypoints = zip(place.inliers.view.tolist(), place.inliers.feature.tolist(), strict=True)
        own = map_.observations.landmark[[rows_of[view][feature] for view, feature in keypoints]]
        pairs.append(np.stack([own, place.inliers.landmark], axis=1)[own >= 0])
    merged, report = merge_landmarks(map_, np.concatenate(pairs))
    return merged, report.num_merged


def _code(reason: str) -> str:
    """Return a reason without its figures, so that reasons can be counted."""
    return re.sub(r"[\d.]+ ", "", reason)
