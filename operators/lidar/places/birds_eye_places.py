"""Places recognised from above: features vote for places, and a planar motion must explain them.

Source: Gupta et al., Effectively detecting loop closures using point cloud density maps, ICRA 2024 (MapClosures).
"""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.lidar.places.birds_eye import BirdsEye, BirdsEyeConfig, birds_eye
from mapstream.operators.lidar.places.planar_motion import planar_motion
from mapstream.operators.lidar.places.recognizers import Proposal
from mapstream.operators.places.growing import Growing
from mapstream.operators.places.indices.faiss_indices import Exact
from mapstream.streams.arrays import FloatArray, IntArray

_NEIGHBOURS = 10  # of each feature among all places; those that overlap share features
_WIDTH = 32  # bytes of a descriptor


class BirdsEyePlacesConfig(BirdsEyeConfig):
    """How places look from above, and when two are alike."""

    max_differing_bits: PositiveInt = 50
    """Of 256, between two features that match."""
    num_candidates: PositiveInt = 5
    """Places with most votes, which are compared."""
    tolerance_m: PositiveFloat = 0.6
    """Between two features that a motion brings together."""
    num_samples: PositiveInt = 500
    """Of pairs of features, from which a motion is guessed."""
    min_inliers: PositiveInt = 22
    """Features that agree on the motion."""


class BirdsEyePlaces:
    """All places with their features; see `PlaceRecognizer`."""

    def __init__(self, config: BirdsEyePlacesConfig) -> None:
        self._config = config
        self._index = Exact(_WIDTH, "uint8")
        self._owners = Growing()  # of the features in the index: numbers of places
        self._places: list[tuple[int, BirdsEye]] = []

    def add(self, key: int, points: FloatArray) -> None:
        """Take in a place as `PlaceRecognizer.add` says."""
        seen = birds_eye(points, self._config)
        if len(seen.descriptors):
            self._index.add(seen.descriptors)
            self._owners.extend(np.full(len(seen.descriptors), len(self._places)))
        self._places.append((key, seen))

    def propose(self, points: FloatArray) -> list[Proposal]:
        """Return the likeliest places as `PlaceRecognizer.propose` says."""
        seen = birds_eye(points, self._config)
        compared = (self._compare(seen, place) for place in self._voted(seen).tolist())
        proposals = [each for each in compared if each.num_inliers >= self._config.min_inliers]
        return sorted(proposals, key=lambda each: (-each.num_inliers, each.key))

    def _voted(self, seen: BirdsEye) -> IntArray:
        """Return the places with most votes; a feature votes once for each."""
        if not (len(seen.descriptors) and len(self._index)):
            return np.empty(0, np.int64)
        found = self._index.search(seen.descriptors, min(_NEIGHBOURS, len(self._index)))
        is_alike = (found.rows >= 0) & (found.distances <= self._config.max_differing_bits)
        feature, _ = np.nonzero(is_alike)
        place = self._owners.values[found.rows[is_alike]]
        voters = np.unique(np.column_stack([place, feature]), axis=0)[:, 0]
        votes = np.bincount(voters, minlength=len(self._places))
        best = np.argsort(-votes, kind="stable")[: self._config.num_candidates]
        return best[votes[best] > 0]

    def _compare(self, seen: BirdsEye, place: int) -> Proposal:
        key, known = self._places[place]
        pairs = _matches(seen, known, self._config.max_differing_bits)
        motion = planar_motion(
            seen.positions[pairs[:, 0]],
            known.positions[pairs[:, 1]],
            tolerance_m=self._config.tolerance_m,
            num_samples=self._config.num_samples,
            seed=key % 2**32,
        )
        T_place_query = known.T_level_base.inverse() @ motion.T_target_source @ seen.T_level_base
        return Proposal(key=key, T_place_query=T_place_query, num_inliers=motion.num_inliers)


def _matches(a: BirdsEye, b: BirdsEye, max_differing_bits: int) -> IntArray:
    """Return the features of two places that are alike (M, 2)."""
    index = Exact(_WIDTH, "uint8")
    index.add(b.descriptors)
    found = index.search(a.descriptors, 1)
    of_a = np.flatnonzero((found.rows[:, 0] >= 0) & (found.distances[:, 0] <= max_differing_bits))
    pairs: IntArray = np.column_stack([of_a, found.rows[of_a, 0]])
    return pairs
