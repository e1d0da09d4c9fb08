"""From measurements on a pose to edges, outer frames and landmarks of a map."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_facts import with_facts_of
from mapstream.recordings.maps.plane_hulls import with_hulls_of
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges, Frames, Landmarks
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef, OuterFrame

_KINDS_WITH_AXES = ("pose", "plane")  # of landmarks that have an orientation


def add_constraints(map_: Map, mission_id: str, constraints: Sequence[Constraint]) -> Map:
    """Return the map with one edge for each measurement, at the vertex of its stamp.

    Outer frames and landmarks that the map does not know are added; a name is one frame, one landmark.
    Planes grow by the outlines of what was seen of them; objects get the extents and texts that were seen.

    Raises:
        MapError: If there is no vertex at a stamp, or a payload is not JSON.
    """
    if not constraints:
        return map_
    vertices = map_.vertex_rows(mission_id, [c.stamp_ns for c in constraints])
    map_ = _with_frames(map_, [c.outer for c in constraints if c.outer is not None])
    map_ = _with_landmarks(map_, constraints, vertices.tolist())
    frames = {str(name): row for row, name in enumerate(map_.frames.name)}
    landmarks = {row.tobytes(): at for at, row in enumerate(map_.landmarks.id)}
    added = Edges(
        kind=np.array([c.kind for c in constraints], dtype=object),
        vertex_a=vertices,
        frame=np.array([-1 if c.outer is None else frames[c.outer.name] for c in constraints]),
        landmark_a=np.array(
            [-1 if c.landmark is None else landmarks[landmark_id(c.landmark)] for c in constraints]
        ),
        T_a_b=np.array([c.T_a_b.matrix for c in constraints]),
        covariance=np.array([c.covariance for c in constraints]),
        is_switchable=np.array([c.is_switchable for c in constraints]),
        source=np.array([c.source for c in constraints], dtype=object),
        payload=np.array([_payload(c) for c in constraints], dtype=object),
    )
    first = len(map_.edges)
    map_ = append_edges(map_, added)
    new = np.arange(first, len(map_.edges))
    return with_facts_of(with_hulls_of(map_, new), new)


def landmark_id(landmark: LandmarkRef) -> bytes:
    """Return the id of a landmark that measurements recognise by name."""
    return derived_id("landmark", landmark.kind, landmark.name)


def _payload(constraint: Constraint) -> bytes:
    """Return what the kind needs as JSON, with the place of a sensor that is not at the base."""
    try:
        given = json.loads(constraint.payload or b"{}")
    except ValueError as error:
        raise MapError(
            f"a constraint of kind {constraint.kind} at {constraint.stamp_ns} ns: its payload is no"
            f" JSON: {constraint.payload[:80]!r}"
        ) from error
    T_base_sensor = constraint.T_base_sensor
    if T_base_sensor is not SE3.identity() and not np.array_equal(T_base_sensor.matrix, np.eye(4)):
        given["T_base_sensor"] = [*T_base_sensor.t.tolist(), *T_base_sensor.quat_xyzw.tolist()]
    return json.dumps(given, sort_keys=True).encode() if given else b""


def _with_frames(map_: Map, outer: Iterable[OuterFrame]) -> Map:
    known = set(map_.frames.name)
    new = list({frame.name: frame for frame in outer if frame.name not in known}.values())
    if not new:
        return map_
    identity, nowhere = SE3.identity(), np.full(3, np.nan)
    added = Frames(
        id=id_array(derived_id("frame", frame.name) for frame in new),
        name=np.array([frame.name for frame in new], dtype=object),
        T_map_frame=np.array([(frame.T_map_frame or identity).matrix for frame in new]),
        is_known=np.array([frame.T_map_frame is not None for frame in new]),
        crs=np.array([frame.crs for frame in new], dtype=object),
        origin_lla=np.array([nowhere if f.origin_lla is None else f.origin_lla for f in new]),
    )
    return replace(map_, frames=concatenate([map_.frames, added]))


def _with_landmarks(map_: Map, constraints: Sequence[Constraint], vertices: Sequence[int]) -> Map:
    """Add landmarks that are new, each fixed to the oldest vertex from which it is seen here."""
    known = {row.tobytes() for row in map_.landmarks.id}
    seen = sorted(zip(vertices, constraints, strict=True), key=lambda pair: pair[1].stamp_ns)
    new: dict[bytes, tuple[int, Constraint]] = {}
    for vertex, constraint in seen:
        if constraint.landmark is not None and landmark_id(constraint.landmark) not in known:
            new.setdefault(landmark_id(constraint.landmark), (vertex, constraint))
    if not new:
        return map_
    first = [constraint for _, constraint in new.values()]
    refs = [constraint.landmark or LandmarkRef(name="") for constraint in first]
    unknown = np.full(4, np.nan)
    added = Landmarks(
        id=id_array(new),
        kind=np.array([ref.kind for ref in refs], dtype=object),
        label=np.array([ref.label for ref in refs], dtype=object),
        vertex=np.array([vertex for vertex, _ in new.values()]),
        p_base=np.array([c.T_a_b.t for c in first]),
        quat_base_xyzw=np.array(
            [
                c.T_a_b.quat_xyzw if ref.kind in _KINDS_WITH_AXES else unknown
                for c, ref in zip(first, refs, strict=True)
            ]
        ),
    )
    return replace(map_, landmarks=concatenate([map_.landmarks, added]))
