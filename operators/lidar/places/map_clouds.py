"""A finished LiDAR map that clouds are compared with: from near a guess, or from nowhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.lidar.aligning import AligningConfig
from mapstream.operators.lidar.constraints.keyframe_clouds import KeyframeClouds
from mapstream.operators.lidar.loop_matcher import Gate
from mapstream.operators.lidar.places.place_matcher import (
    ACCEPTED,
    PlaceMatcher,
    PlaceMatchingConfig,
)
from mapstream.operators.lidar.registration import RegistrationResult
from mapstream.operators.operator import warn
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError, MapError
from mapstream.streams.geometry import SE3


class MapCloudsConfig(AligningConfig):
    """How a cloud is registered to the map where the robot is roughly known, and found where it is not."""

    places: PlaceMatchingConfig = Field(default_factory=PlaceMatchingConfig)
    """How a robot that is lost is found."""
    neighbours: NonNegativeInt = 2
    """Keyframes of the map on either side whose clouds are merged."""
    spacing_m: NonNegativeFloat = 2.0
    """Between places of the map in which a lost robot is looked for."""
    min_inlier_fraction: PositiveFloat = 0.6
    """Of the points, for a registration near a guess to be believed."""
    max_rmse_m: PositiveFloat = 0.08
    """Of the inliers."""
    max_shift_m: PositiveFloat = 1.0
    """How far it may lie from the guess."""
    max_turn_deg: PositiveFloat = 15.0
    """How far it may turn away from it."""
    max_cloud_bytes: PositiveInt = 128_000_000
    """Memory for clouds of the map; all of them are on disk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Located:
    """Where a cloud was taken, or why nobody knows."""

    verdict: str
    T_map_base: SE3 | None = None
    covariance: FloatArray | None = None  # (6, 6) of T_map_base
    num_inliers: int = 0  # points on the map's surfaces


class MapClouds:
    """The clouds of a map's anchored missions; nothing is ever added.

    Raises:
        MapError: If the map has none.
    """

    def __init__(self, map_: Map, folder: Path, config: MapCloudsConfig) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415  # scipy takes its time

        self._config = config
        self._clouds = KeyframeClouds(map_, folder, config.max_cloud_bytes)
        vertices = self._clouds.vertices
        is_known = map_.missions.is_base_frame_known[map_.vertices.mission[vertices]]
        self._vertices = vertices[is_known]
        if not len(self._vertices):
            raise MapError(f"{folder}: no mission that is anchored has clouds to localise in")
        self._poses = map_.T_map_base(self._vertices)
        self._tree = cKDTree(self._poses[:, :3, 3])
        self._row = {int(vertex): n for n, vertex in enumerate(self._vertices)}
        self._registration = config.make_registration()
        self._gate = Gate(
            min_inlier_fraction=config.min_inlier_fraction,
            max_rmse_m=config.max_rmse_m,
            max_turn_rad=float(np.radians(config.max_turn_deg)),
        )
        self._places = PlaceMatcher(config.places, self._around)
        self._look()

    def _look(self) -> None:
        """Take in the places of the map, with some way between them."""
        last: FloatArray | None = None
        for vertex, pose in zip(self._vertices.tolist(), self._poses, strict=True):
            if last is not None and np.linalg.norm(pose[:3, 3] - last) < self._config.spacing_m:
                continue
            last = pose[:3, 3]
            try:
                self._places.add(vertex)
            except EstimationError as error:
                warn(f"a place of the map cannot be recognised: {error}")

    def _around(self, vertex: int) -> FloatArray:
        return self._clouds.around(vertex, self._config.neighbours, self._config.neighbours)

    def near(self, points: FloatArray, T_map_base: SE3) -> Located:
        """Return where a cloud (N, 3) in the base frame lies, near a guess."""
        _, row = self._tree.query(T_map_base.t)
        T_map_vertex = SE3(self._poses[row])
        T_guess = T_map_vertex.inverse() @ T_map_base
        try:
            target = self._around(int(self._vertices[row]))
            result = self._registration.align(points, target, T_guess)
        except EstimationError as error:
            return Located(verdict=str(error))
        refusal = self._gate.refusal(result, T_guess, self._config.max_shift_m)
        return Located(verdict=refusal) if refusal else _located(T_map_vertex, result, points)

    def anywhere(self, points: FloatArray) -> Located:
        """Return where a cloud (N, 3) in the base frame lies, if the map tells."""
        try:
            judged = self._places.recognize(points)
        except EstimationError as error:
            return Located(verdict=str(error))
        if not judged:
            return Located(verdict="it looks like no place of the map")
        best = judged[-1]
        if best.verdict != ACCEPTED or best.result is None:
            return Located(verdict=best.verdict)
        T_map_vertex = SE3(self._poses[self._row[best.proposal.key]])
        return _located(T_map_vertex, best.result, points)


def _located(T_map_vertex: SE3, result: RegistrationResult, points: FloatArray) -> Located:
    return Located(
        verdict=ACCEPTED,
        T_map_base=T_map_vertex @ result.T_target_source,
        covariance=result.covariance,
        num_inliers=round(result.inlier_fraction * len(points)),
    )
