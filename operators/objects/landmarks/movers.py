"""Tracks of what moves, which is no landmark."""

from __future__ import annotations

import numpy as np

from mapstream.operators.objects.landmarks.sightings import Sightings
from mapstream.operators.objects.moving import MovingConfig, Path, is_moving
from mapstream.recordings.maps.detections import points_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array, IntArray

_SPAN_NS = (
    3_000_000_000  # within which a thing is asked whether it moves: odometry drifts in longer times
)
_MOST_SIGHTINGS = 60  # in it


def moves(map_: Map, sightings: Sightings, members: IntArray, config: MovingConfig) -> bool:
    """Return whether sightings of one track show a thing that moves, by its 3D points; without any it stands."""
    members = members[np.isfinite(sightings.views.points[members]).all(axis=1)]
    spans = (sightings.stamps_ns[members] - sightings.stamps_ns[members].min(initial=0)) // _SPAN_NS
    return any(
        is_moving(_path(map_, sightings, members[spans == span]), config)
        for span in np.unique(spans).tolist()
    )


def _path(map_: Map, sightings: Sightings, members: IntArray) -> Path:
    few = np.linspace(0, len(members) - 1, min(len(members), _MOST_SIGHTINGS)).round()
    members = members[few.astype(np.int64)]
    return Path(
        sightings.stamps_ns[members],
        sightings.views.points[members],
        sightings.views.point_sigmas_m[members],
        sightings.views.T_map_sensor[members, :3, 3],
        tuple(map_points(map_, sightings, member) for member in members.tolist()),
    )


def map_points(map_: Map, sightings: Sightings, member: int) -> Float32Array:
    """Return the points (K, 3) of a sighting in the map."""
    T = sightings.views.T_map_sensor[member]
    points = points_of(map_, int(sightings.detections[member]))
    placed: Float32Array = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return placed
