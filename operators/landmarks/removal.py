"""Landmarks that are bad and observations that cannot be true, taken out; keypoints stay, without a landmark.

Source: maplab's commands remove_bad_landmarks (rbl) and remove_invalid_observations (rio).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.landmarks.views import (
    T_map_sensor_of,
    reprojection_errors_px,
    views_of,
)
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import named
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray


class InvalidConfig(OperatorConfig):
    """When an observation cannot be true."""

    max_reprojection_error_px: PositiveFloat = 50.0
    """Landmarks behind the camera are invalid at any distance."""
    max_error_m: PositiveFloat = 2.0
    """Of 3D points."""
    most_baselines: PositiveFloat | None = None
    """Of points beyond so many baselines only the first camera of a vertex counts; null: all do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovalReport:
    """What went."""

    num_landmarks: int
    num_observations: int  # that have no landmark any more
    num_edges: int = 0  # that ended at a landmark which went


def remove_bad_landmarks(map_: Map) -> tuple[Map, RemovalReport]:
    """Return the map without landmarks of bad quality; those that people named stay."""
    is_bad = (map_.landmarks.quality == "bad") & ~named(map_.landmarks)
    return without_landmarks(map_, np.asarray(is_bad))


def remove_invalid_observations(
    map_: Map, config: InvalidConfig | None = None
) -> tuple[Map, RemovalReport]:
    """Return the map in which no landmark is far from where an observation saw it.

    Landmarks that nothing sees any more go, unless people named them.
    """
    config = config or InvalidConfig()
    rows = np.flatnonzero(map_.observations.landmark >= 0)
    is_false = reprojection_errors_px(map_, rows) > config.max_reprojection_error_px
    landmarks = map_.observations.landmark[rows]
    p_map = map_.T_map_landmark(landmarks)[:, :3, 3]
    misses_m = np.linalg.norm(views_of(map_, rows).points - p_map, axis=1)
    is_false |= misses_m > config.max_error_m
    if config.most_baselines is not None:
        is_false |= _far_pairs(map_, rows, p_map, config.most_baselines)
    landmark = map_.observations.landmark.copy()
    landmark[rows[is_false]] = -1
    loose = replace(map_, observations=replace(map_.observations, landmark=landmark))
    lost = np.zeros(len(map_.landmarks), bool)
    lost[np.setdiff1d(landmarks, landmark[rows])] = True
    lost[map_.edges.landmark_a[map_.edges.landmark_a >= 0]] = False
    lost[map_.edges.landmark_b[map_.edges.landmark_b >= 0]] = False
    lost[named(map_.landmarks)] = False
    left, report = without_landmarks(loose, lost)
    return left, replace(report, num_observations=int(is_false.sum()))


def _far_pairs(map_: Map, rows: IntArray, p_map: FloatArray, most_baselines: float) -> BoolArray:
    """Return which observations (N,) see a landmark (N, 3) that an earlier row saw from the same vertex, too far away.

    The calibration of a pair of cameras errs by some tenth of a pixel, always to the same side. Near points hardly
    notice; of far ones many images would average to a distance that is certain and wrong.
    """
    seen = map_.observations
    order = np.lexsort((rows, seen.landmark[rows], seen.vertex[rows]))
    pair = np.column_stack([seen.vertex[rows], seen.landmark[rows]])[order]
    again = np.flatnonzero((pair[1:] == pair[:-1]).all(axis=1)) + 1
    second, first = order[again], order[again - 1]
    places = T_map_sensor_of(map_, rows)[:, :3, 3]
    baselines_m = np.linalg.norm(places[second] - places[first], axis=1)
    distances_m = np.linalg.norm(p_map[second] - places[second], axis=1)
    is_far = np.zeros(len(rows), bool)
    is_far[second[distances_m > most_baselines * baselines_m]] = True
    return is_far


def without_landmarks(map_: Map, goes: BoolArray) -> tuple[Map, RemovalReport]:
    """Return the map without landmarks (L,); their observations stay as keypoints, their edges go."""
    landmark = map_.observations.landmark
    is_freed = np.append(goes, False)[landmark]  # -1 is the last
    freed = replace(map_.observations, landmark=np.where(is_freed, -1, landmark))
    left = replace(map_, observations=freed).select(landmarks=~goes)
    return left, RemovalReport(
        num_landmarks=int(goes.sum()),
        num_observations=int(is_freed.sum()),
        num_edges=len(map_.edges) - len(left.edges),
    )
