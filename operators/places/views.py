"""What one sensor sees at one moment with one kind of features: from a message, or from a vertex of a map."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapstream.operators.landmarks.motion import Motion, moments
from mapstream.operators.landmarks.sensors import T_base_sensor_of
from mapstream.operators.places.geometry.sightings import Sensor
from mapstream.operators.places.indices.index import Descriptors
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.recordings.maps.features import descriptors_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import ImageFeatures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """Keypoints that can be recognised: each has a descriptor."""

    kind: str
    frame: str
    sensor: Sensor
    descriptors: Descriptors  # (N, D)
    keypoints_px: FloatArray  # (N, 2)
    points_sensor: FloatArray  # (N, 3) [m] at one moment; NaN where only a ray is known
    sigmas_m: FloatArray  # (N,)
    rows: IntArray  # (N,) of observations in the map, or of the message

    def __len__(self) -> int:
        return len(self.rows)


def view_of(features: ImageFeatures) -> View:
    """Return what a message says."""
    n = len(features)
    points = np.full((n, 3), np.nan) if features.points_m is None else features.points_m
    sigmas = np.full(n, np.nan) if features.point_sigmas_m is None else features.point_sigmas_m
    return View(
        kind=features.kind,
        frame=features.frame,
        sensor=Sensor(T_base_sensor=features.T_base_sensor, calibration=features.camera),
        descriptors=features.descriptors,
        keypoints_px=features.keypoints_px.astype(np.float64),
        points_sensor=points.astype(np.float64),
        sigmas_m=sigmas.astype(np.float64),
        rows=np.arange(n),
    )


class VertexViews:
    """Gives the views of a map's vertices."""

    def __init__(self, map_: Map, kinds: Collection[str] = ()) -> None:
        self._map = map_
        sets = map_.feature_sets
        chosen = sets.width > 0
        if kinds:
            chosen &= np.isin(sets.kind, list(kinds))
        self._sets_of: dict[int, list[int]] = {}
        for row in np.flatnonzero(chosen).tolist():
            self._sets_of.setdefault(int(sets.vertex[row]), []).append(row)
        seen = map_.observations
        self._rows = np.argsort(seen.feature_set, kind="stable")
        self._ends = np.searchsorted(seen.feature_set[self._rows], np.arange(len(sets) + 1))
        self._sensors: dict[tuple[int, str], Sensor] = {}

    def at(self, vertex: int) -> list[View]:
        """Return what was seen from a vertex."""
        return list(self._views(vertex))

    def _views(self, vertex: int) -> Iterator[View]:
        map_ = self._map
        for row in self._sets_of.get(vertex, []):
            rows = self._rows[self._ends[row] : self._ends[row + 1]]
            if not len(rows):
                continue
            seen = map_.observations
            sensor = self._sensor(vertex, map_.feature_sets.sensor[row], rows)
            yield View(
                kind=map_.feature_sets.kind[row],
                frame=map_.feature_sets.sensor[row],
                sensor=sensor,
                descriptors=descriptors_of(map_, rows),
                keypoints_px=seen.keypoint_px[rows].astype(np.float64),
                points_sensor=self._points_at_vertex(vertex, rows, sensor.T_base_sensor),
                sigmas_m=seen.sigma_m[rows].astype(np.float64),
                rows=rows,
            )

    def _points_at_vertex(self, vertex: int, rows: IntArray, T_base_sensor: SE3) -> FloatArray:
        """Return the 3D points (N, 3) as the sensor would have seen them at the vertex, not within its sweep."""
        seen = self._map.observations
        points, offsets_ns = seen.p_sensor[rows].astype(np.float64), seen.offset_ns[rows]
        swept = np.flatnonzero(np.isfinite(points[:, 0]) & (offsets_ns != 0))
        if len(swept):
            at = moments(self._motion, np.full(len(swept), vertex), offsets_ns[swept])
            T = T_base_sensor.inverse().matrix @ at.T_vertex_moment @ T_base_sensor.matrix
            points[swept] = np.einsum("nij,nj->ni", T[:, :3, :3], points[swept]) + T[:, :3, 3]
        return points

    @cached_property
    def _motion(self) -> Motion:
        return Motion.of(self._map)

    def _sensor(self, vertex: int, name: str, rows: IntArray) -> Sensor:
        key = (int(self._map.vertices.mission[vertex]), name)
        if key not in self._sensors:
            camera = cameras_of(self._map, key[0]).get(name)
            self._sensors[key] = Sensor(
                T_base_sensor=SE3(T_base_sensor_of(self._map, rows[:1])[0]),
                calibration=None if camera is None else camera.calibration,
            )
        return self._sensors[key]
