"""Keypoints of images in a map: as observations with their descriptors, whose landmarks come later.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A2 (any number of kinds of features side by side).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.cameras import Camera, cameras_of, with_cameras
from mapstream.recordings.maps.columns import BytesArray, TextArray
from mapstream.recordings.maps.detections import rows_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.semantic_tables import Detections
from mapstream.recordings.maps.tables import FeatureSets, Observations
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.vision import ImageFeatures

KEYPOINT_SIGMA_PX = 0.8
"""Of keypoints whose detector says nothing (maplab's for tracked features)."""
Descriptors = npt.NDArray[Any]  # (N, D) uint8 bits or float32
_DTYPES = ("uint8", "float32")


def add_features(
    map_: Map, mission_row: int, seen: Sequence[tuple[int, int, ImageFeatures]]
) -> Map:
    """Return the map with an observation of each keypoint, and the cameras that saw them.

    Args:
        map_: The map.
        mission_row: The mission of all that was seen.
        seen: The row of a vertex, its stamp [ns], and features that belong to it.

    Raises:
        MapError: If descriptors are neither uint8 nor float32.
    """
    if not seen:
        return map_
    described: list[tuple[int, int, ImageFeatures]] = []
    observed: list[Observations] = []
    detected: list[Detections] = []
    num_observed = len(map_.observations)
    for vertex, stamp_ns, features in seen:
        if features.descriptors.dtype.name not in _DTYPES:
            found = f"{features.descriptors.dtype.name} of kind {features.kind}"
            raise MapError(f"descriptors are uint8 bits or float32 numbers, not {found}")
        feature_set = -1
        if features.descriptors.size:
            feature_set = len(map_.feature_sets) + len(described)
            described.append((vertex, stamp_ns, features))
        observed.append(_observations(vertex, stamp_ns, features, feature_set))
        if features.objects is not None:
            detected.append(rows_of(features.objects, num_observed))
        num_observed += len(features)
    map_ = replace(
        map_,
        feature_sets=concatenate([map_.feature_sets, _feature_sets(described)]),
        observations=concatenate([map_.observations, *observed]),
        detections=concatenate([map_.detections, *detected]),
    )
    known = cameras_of(map_, mission_row)
    new = {
        f.frame: Camera(calibration=f.camera, T_base_sensor=f.T_base_sensor)
        for _, _, f in reversed(seen)
        if f.camera is not None and f.frame not in known
    }
    map_ = with_cameras(map_, mission_row, new) if new else map_
    return _with_places(map_, mission_row, [f for _, _, f in seen if f.camera is None])


def _with_places(map_: Map, mission_row: int, seen: Sequence[ImageFeatures]) -> Map:
    """Return the map with the places of sensors that are no cameras, where the mission does not know them."""
    sensors = json.loads(map_.missions.sensors[mission_row])
    known = {*sensors, *sensors.get("cameras", {})}
    places = {f.frame: f.T_base_sensor for f in reversed(seen) if f.frame not in known}
    if not places:
        return map_
    for name, place in places.items():
        sensors[name] = {"T_base_sensor": [*place.t.tolist(), *place.quat_xyzw.tolist()]}
    texts = map_.missions.sensors.copy()
    texts[mission_row] = json.dumps(sensors, sort_keys=True)
    return replace(map_, missions=replace(map_.missions, sensors=texts))


def descriptors_of(map_: Map, rows: IntArray) -> Descriptors:
    """Return the descriptors (N, D) of observations of one kind.

    Raises:
        MapError: If one has no descriptor, or they are not alike.
    """
    seen, sets = map_.observations, map_.feature_sets
    used, at = np.unique(seen.feature_set[rows], return_inverse=True)
    if (used < 0).any():
        raise MapError(f"{(seen.feature_set[rows] < 0).sum()} observations have no descriptor")
    shapes = {(sets.dtype[row], int(sets.width[row])) for row in used.tolist()}
    if len(shapes) > 1:
        raise MapError(f"descriptors of several shapes at once: {sorted(shapes)}")
    dtype, width = shapes.pop() if shapes else ("uint8", 0)
    blocks = [descriptor_block(map_, row) for row in used.tolist()]
    starts = np.cumsum([0, *map(len, blocks)])[:-1]
    joined: Descriptors = np.concatenate([np.empty((0, width), dtype), *blocks])
    return joined[starts[at] + seen.feature[rows]]


def descriptor_block(map_: Map, feature_set: int) -> Descriptors:
    """Return all descriptors (N, D) of a set, as a view."""
    sets = map_.feature_sets
    width, dtype = int(sets.width[feature_set]), np.dtype(sets.dtype[feature_set])
    flat = np.frombuffer(sets.descriptors[feature_set], dtype.newbyteorder("<"))
    return flat.reshape(-1, width) if width else np.empty((0, 0), dtype)


def _feature_sets(sets: Sequence[tuple[int, int, ImageFeatures]]) -> FeatureSets:
    features = [f for _, _, f in sets]
    return FeatureSets(
        vertex=np.array([vertex for vertex, _, _ in sets]),
        sensor=_texts([f.frame for f in features]),
        kind=_texts([f.kind for f in features]),
        offset_ns=np.array([f.stamp_ns - stamp_ns for _, stamp_ns, f in sets]),
        dtype=_texts([f.descriptors.dtype.name for f in features]),
        width=np.array([f.descriptors.shape[1] for f in features]),
        descriptors=_blocks(features),
    )


def _blocks(features: Sequence[ImageFeatures]) -> BytesArray:
    little = [f.descriptors.astype(f.descriptors.dtype.newbyteorder("<")) for f in features]
    blocks = np.empty(len(little), dtype=object)
    blocks[:] = [array.tobytes() for array in little]
    return blocks


def _observations(
    vertex: int, stamp_ns: int, features: ImageFeatures, feature_set: int
) -> Observations:
    n = len(features)
    known: dict[str, Any] = {
        "p_sensor": features.points_m,
        "sigma_m": features.point_sigmas_m,
        "score": features.scores,
        "scale": features.scales,
        "orientation_rad": features.orientations_rad,
    }
    offsets_ns = np.zeros(n, np.int64) if features.offsets_ns is None else features.offsets_ns
    return Observations(
        vertex=np.full(n, vertex),
        landmark=np.full(n, -1),
        sensor=_texts([features.frame] * n),
        kind=_texts([features.kind] * n),
        offset_ns=features.stamp_ns - stamp_ns + offsets_ns,
        keypoint_px=features.keypoints_px,
        label=_texts([""] * n if features.objects is None else features.objects.labels),
        sigma=_or(features.sigmas_px, n, KEYPOINT_SIGMA_PX),
        track=np.full(n, -1) if features.track_ids is None else features.track_ids,
        feature_set=np.full(n, feature_set),
        feature=np.arange(n) if feature_set >= 0 else np.full(n, -1),
        **{name: values for name, values in known.items() if values is not None},
    )


def _or(values: Float32Array | None, n: int, usual: float) -> Float32Array:
    return np.full(n, usual, np.float32) if values is None else values


def _texts(texts: Sequence[str]) -> TextArray:
    return np.array(texts, dtype=object)
