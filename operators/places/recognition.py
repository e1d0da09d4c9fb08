"""Recognising where a frame was taken: matches, places that they speak of, and a pose that explains them.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-C; its loop engine.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.covisibility import CovisibilityConfig, Place, places
from mapstream.operators.places.database import LookConfig, Matches, PlaceDatabase
from mapstream.operators.places.geometry.consensus import Consensus, ConsensusConfig, find_pose
from mapstream.operators.places.geometry.mirrored import mirrored
from mapstream.operators.places.geometry.refinement import Noise, errors
from mapstream.operators.places.geometry.sightings import Sightings, make_sightings
from mapstream.operators.places.views import View
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

ACCEPTED = "accepted"


class RecognitionConfig(OperatorConfig):
    """How a frame is compared with a map."""

    kinds: tuple[str, ...] = ()
    """Of the features that are compared; all that have descriptors without."""
    look: LookConfig = Field(default_factory=LookConfig)
    covisibility: CovisibilityConfig = Field(default_factory=CovisibilityConfig)
    consensus: ConsensusConfig = Field(default_factory=ConsensusConfig)
    min_inlier_share: float = Field(default=0.25, ge=0.0, le=1.0)
    """Of the keypoints that match a place, those that must agree; textures that repeat match without agreeing."""
    max_sigma_m: PositiveFloat = 0.3
    """How uncertain the position may be, along any axis."""
    max_mirrored_share: float = Field(default=0.8, ge=0.0, le=1.0)
    """Of the inliers, those that may fit the mirrored pose too, if it is farther off than that; 1: any may."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A place that a frame was compared with, and why it was accepted or refused."""

    vertex: int  # the one with most votes
    score: float
    num_votes: int
    num_matches: int  # with landmarks that are seen there
    num_inliers: int
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """The place where a frame was taken."""

    vertex: int  # that sees most of what the frame sees
    consensus: Consensus
    inliers: Matches  # no keypoint of a view comes twice, and no landmark


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recognition:
    """What came of comparing a frame with the map."""

    num_matches: int
    candidates: tuple[Candidate, ...]
    found: Found | None  # nothing, if every candidate was refused

    @property
    def reason(self) -> str:
        """Why no place was recognised, or that one was."""
        if self.found is not None:
            return ACCEPTED
        if not self.candidates:
            return f"{self.num_matches} matches, which speak of no place"
        return self.candidates[0].verdict


def recognize(
    views: Sequence[View],
    database: PlaceDatabase,
    landmarks_map: FloatArray,
    config: RecognitionConfig,
    *,
    seed: int,
    vertices: Sequence[int] | None = None,
) -> Recognition:
    """Return where a frame was taken, if the map tells.

    Args:
        views: Of one moment, of all sensors and kinds.
        database: Of the map.
        landmarks_map: Positions (L, 3) of all landmarks in the map frame [m].
        config: How it is compared.
        seed: Of the search for a pose; `seed_of` the frame's id.
        vertices: Places that something else found to be alike, a global descriptor for instance; without
            them the matches vote.
    """
    matches = database.match(views, vertices)
    candidates = []
    for place in places(matches, database, config.covisibility):
        votes = int((place.matches.vertex == place.vertex).sum())
        verdict, found = ACCEPTED, None
        try:
            found = _verified(views, place, database, landmarks_map, config, seed)
        except EstimationError as error:
            verdict = str(error)
        candidates.append(
            Candidate(
                vertex=place.vertex if found is None else found.vertex,
                score=float(place.scores.max()),
                num_votes=votes,
                num_matches=len(place.matches),
                num_inliers=0 if found is None else len(found.inliers),
                verdict=verdict,
            )
        )
        if found is not None:
            return Recognition(num_matches=len(matches), candidates=tuple(candidates), found=found)
    return Recognition(num_matches=len(matches), candidates=tuple(candidates), found=None)


def seed_of(name: bytes) -> int:
    """Return the seed of a frame with this id."""
    return zlib.crc32(name)


def sightings_of(views: Sequence[View], matches: Matches, landmarks_map: FloatArray) -> Sightings:
    """Return where the matched keypoints were seen, and where their landmarks are."""

    def gathered(name: str, width: tuple[int, ...]) -> FloatArray:
        values = np.full((len(matches), *width), np.nan)
        for number, view in enumerate(views):
            rows = matches.view == number
            values[rows] = getattr(view, name)[matches.feature[rows]]
        return values

    return make_sightings(
        tuple(view.sensor for view in views),
        sensor=matches.view,
        points_map=landmarks_map[matches.landmark],
        keypoints_px=gathered("keypoints_px", (2,)),
        points_sensor=gathered("points_sensor", (3,)),
        sigmas_m=gathered("sigmas_m", ()),
    )


def refuse_ambiguous(inliers: Sightings, consensus: Consensus, config: RecognitionConfig) -> None:
    """Refuse a pose whose sightings fit another one too, since they are of a small or far part of one plane.

    Args:
        inliers: The sightings that agree with the pose.
        consensus: Its pose.
        config: How many may fit the other one, and how far off it may be.

    Raises:
        EstimationError: If too many fit the other one.
    """
    settings = config.consensus
    best = consensus.pose.T_map_base.matrix
    rival = mirrored(inliers, best)
    off_m = float(np.linalg.norm(rival[:3, 3] - best[:3, 3]))
    noise = Noise(sigma_px=settings.sigma_px, sigma_m=settings.sigma_m)
    share = float((errors(inliers, rival, noise) <= settings.max_sigmas).mean())
    if off_m > config.max_sigma_m and share > config.max_mirrored_share:
        raise EstimationError(f"{share:.2f} of the inliers fit a pose {off_m:.1f} m off as well")


def _verified(  # all that is known
    views: Sequence[View],
    place: Place,
    database: PlaceDatabase,
    landmarks_map: FloatArray,
    config: RecognitionConfig,
    seed: int,
) -> Found:
    """Return the pose that explains the matches of a place.

    Raises:
        EstimationError: If none does; the message says why.
    """
    num, least = len(place.matches), config.covisibility.min_matches
    if num < least:
        raise EstimationError(f"{num} matches of one place, fewer than {least}")
    sightings = sightings_of(views, place.matches, landmarks_map)
    consensus = find_pose(sightings, config.consensus, seed)
    inliers = _one_to_one(place.matches.take(consensus.is_inlier))
    least, share = config.consensus.min_inliers, len(inliers) / _num_keypoints(place.matches)
    num_landmarks = len(np.unique(inliers.landmark))
    if num_landmarks < least:
        raise EstimationError(f"inliers of {num_landmarks} landmarks, fewer than {least}")
    if share < config.min_inlier_share:
        raise EstimationError(f"{share:.2f} of the keypoints agree, < {config.min_inlier_share:g}")
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(consensus.pose.covariance[3:, 3:])[-1]))
    if sigma_m > config.max_sigma_m:
        raise EstimationError(f"the position is uncertain by {sigma_m:.2f} m")
    refuse_ambiguous(sightings.take(consensus.is_inlier), consensus, config)
    common = [
        int(np.isin(database.landmarks_of(vertex), inliers.landmark).sum())
        for vertex in place.vertices.tolist()
    ]
    nearest = int(place.vertices[int(np.argmax(common))])
    return Found(vertex=nearest, consensus=consensus, inliers=inliers)


def _one_to_one(matches: Matches) -> Matches:
    """Return matches in which no keypoint and no landmark comes twice; those that look most alike stay."""
    matches = matches.take(np.argsort(matches.distance, kind="stable"))
    keypoints = np.stack([matches.view, matches.feature])
    matches = matches.take(np.sort(np.unique(keypoints, axis=1, return_index=True)[1]))
    seen_by = np.stack([matches.view, matches.landmark])  # cameras that overlap see a landmark each
    return matches.take(np.sort(np.unique(seen_by, axis=1, return_index=True)[1]))


def _num_keypoints(matches: Matches) -> int:
    return int(np.unique(np.stack([matches.view, matches.feature]), axis=1).shape[1])
