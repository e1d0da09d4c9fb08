"""Matches that belong together: to landmarks which are seen from places that see each other's landmarks.

Source: maplab's loop engine; Mei, Sibley, Newman, Closing loops without places, IROS 2010.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.database import Matches, PlaceDatabase
from mapstream.operators.places.scoring import Scoring, scores
from mapstream.streams.arrays import FloatArray, IntArray


class CovisibilityConfig(OperatorConfig):
    """Which matches are believed to be of one place."""

    scoring: Scoring = "probability"
    """How vertices are ranked by the matches that vote for them."""
    best_share: float = Field(default=0.25, gt=0.0, le=1.0)
    """Of the vertices with votes, those that are kept."""
    min_vertices: PositiveInt = 4
    """So many are kept, if there are as many."""
    min_matches: PositiveInt = 11
    """Of a place, for it to be looked at."""
    max_places: PositiveInt = 2
    """The largest are looked at."""


class Place:
    """Vertices that see landmarks in common, and the matches to landmarks that they see."""

    def __init__(self, vertices: IntArray, scores: FloatArray, matches: Matches) -> None:
        self.vertices, self.scores, self.matches = vertices, scores, matches

    @property
    def vertex(self) -> int:
        """The one with the best score."""
        return int(self.vertices[np.argmax(self.scores)])


def places(matches: Matches, database: PlaceDatabase, config: CovisibilityConfig) -> list[Place]:
    """Return the places that a frame's matches speak of, the one with most matches first."""
    if not len(matches):
        return []
    vertices, votes = np.unique(matches.vertex, return_counts=True)
    sizes = np.array([database.num_descriptors_of[v] for v in vertices.tolist()])
    score = scores(config.scoring, votes, sizes, len(database))
    num_kept = max(round(config.best_share * len(vertices)), config.min_vertices)
    best = np.sort(np.argsort(-score, kind="stable")[:num_kept])
    found = []
    for group in _components([database.landmarks_of(v) for v in vertices[best].tolist()], matches):
        members = best[group]
        seen = np.unique(
            np.concatenate([database.landmarks_of(v) for v in vertices[members].tolist()])
        )
        chosen = matches.take(np.isin(matches.landmark, seen))
        found.append(Place(vertices[members], score[members], chosen))
    found.sort(key=lambda place: (-len(place.matches), place.vertex))
    return found[: config.max_places]


def _components(landmarks: Sequence[IntArray], matches: Matches) -> list[IntArray]:
    """Return groups of vertices that see matched landmarks in common, by the landmarks that each sees."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # slow to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    matched = np.unique(matches.landmark)
    count = len(landmarks)
    links = []
    for number, seen in enumerate(landmarks):
        at = np.flatnonzero(np.isin(matched, seen))
        links.append(np.stack([np.full(len(at), number), count + at]))
    a, b = np.concatenate(links, axis=1)
    size = count + len(matched)
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    group = connected_components(graph, directed=False)[1][:count]
    return [np.flatnonzero(group == number) for number in np.unique(group)]
