"""Things as landmarks of a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from mapstream.operators.landmarks.merging import merge_landmarks
from mapstream.operators.landmarks.removal import without_landmarks
from mapstream.operators.objects.landmarks.boxes import UprightBox, upright_box
from mapstream.operators.objects.landmarks.middles import with_middles
from mapstream.operators.objects.landmarks.movers import map_points
from mapstream.operators.objects.landmarks.same import Thing
from mapstream.operators.objects.landmarks.sightings import Sightings
from mapstream.recordings.maps.columns import IdArray
from mapstream.recordings.maps.ids import as_keys, derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload, payload_bytes
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Landmarks
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3

KIND = "object"


def written(
    map_: Map, sightings: Sightings, things: Sequence[Thing], goes: Sequence[int]
) -> tuple[Map, int]:
    """Return the map with things as its landmarks and without these rows of landmarks, and how many have an extent."""
    observation = map_.detections.observation[sightings.detections]
    landmark = map_.observations.landmark.copy()
    known = [row for thing in things for row in thing.landmarks]
    landmark[observation[np.isin(sightings.landmarks, known)]] = -1
    rows = _rows(map_, things)
    for row, thing in zip(rows, things, strict=True):
        landmark[observation[thing.members]] = row
    boxes = [_box(map_, sightings, thing) for thing in things]
    table = _table(map_, sightings, things, rows, boxes)
    map_ = with_middles(map_, sightings, [thing.members for thing in things], boxes)
    map_ = replace(
        map_, landmarks=table, observations=replace(map_.observations, landmark=landmark)
    )
    ids = as_keys(table.id[list(goes)])
    pairs = [
        (row, other)
        for row, thing in zip(rows, things, strict=True)
        for other in thing.landmarks[1:]
    ]
    map_, _ = merge_landmarks(map_, np.array(pairs, np.int64))
    map_, _ = without_landmarks(map_, np.isin(as_keys(map_.landmarks.id), ids))
    return map_, sum(box is not None for box in boxes)


def _rows(map_: Map, things: Sequence[Thing]) -> list[int]:
    """Return the row of each thing: its first one in the table, or one at the end."""
    fresh = iter(range(len(map_.landmarks), len(map_.landmarks) + len(things)))
    return [thing.landmarks[0] if thing.landmarks else next(fresh) for thing in things]


def _box(map_: Map, sightings: Sightings, thing: Thing) -> UprightBox | None:
    """Return the box around the points that all views of a thing saw."""
    clouds = [map_points(map_, sightings, member) for member in thing.members.tolist()]
    views = np.repeat(sightings.images[thing.members], [len(cloud) for cloud in clouds])
    return upright_box(np.concatenate(clouds).astype(np.float64), views)


def _table(
    map_: Map,
    sightings: Sightings,
    things: Sequence[Thing],
    rows: Sequence[int],
    boxes: Sequence[UprightBox | None],
) -> Landmarks:
    """Return the landmarks with these things among them, each fixed to the vertex that it has, or that saw it first."""
    new = [thing for thing in things if not thing.landmarks]
    table = concatenate([map_.landmarks, _new(map_, sightings, new)])
    p_base, quat = table.p_base.copy(), table.quat_base_xyzw.copy()
    covariance, label, payload = table.covariance.copy(), table.label.copy(), table.payload.copy()
    T_map_base = map_.T_map_base(table.vertex[list(rows)])
    for row, T, thing, box in zip(rows, T_map_base, things, boxes, strict=True):
        position = thing.place.position if box is None else box.center
        R = T[:3, :3]
        p_base[row] = R.T @ (position - T[:3, 3])
        covariance[row] = _symmetric(R.T @ thing.place.covariance @ R)
        quat[row] = np.nan if box is None else _upright(R, box.yaw_rad)
        label[row] = thing.label
        payload[row] = payload_bytes(dict(_payload(object_payload(table, row), thing, box)))
    return replace(
        table,
        p_base=p_base,
        quat_base_xyzw=quat,
        covariance=covariance,
        label=label,
        payload=payload,
    )


def _payload(
    known: dict[str, object], thing: Thing, box: UprightBox | None
) -> Iterator[tuple[str, object]]:
    """Yield what a landmark says, less what it does not know any more."""
    yield from ((key, value) for key, value in known.items() if key not in ("extent_m", "text"))
    if box is not None:
        yield "extent_m", np.round(box.extent_m, 4).tolist()
    if thing.text:
        yield "text", thing.text


def _upright(R_map_base: FloatArray, yaw_rad: float) -> FloatArray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    R_map_box = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return SE3.from_rotation(R_map_base.T @ R_map_box, np.zeros(3)).quat_xyzw


def _symmetric(matrix: FloatArray) -> FloatArray:
    return (matrix + matrix.T) / 2


def _new(map_: Map, sightings: Sightings, things: Sequence[Thing]) -> Landmarks:
    """Return rows for things, with the ids that their first tracks give."""
    first = np.array([thing.members[0] for thing in things], np.int64)
    seen = map_.detections.observation[sightings.detections[first]]
    vertices: IntArray = map_.observations.vertex[seen]
    return Landmarks(
        id=_ids(map_, vertices, sightings.tracks[first]),
        kind=np.array([KIND] * len(things), object),
        vertex=vertices,
        p_base=np.zeros((len(things), 3)),
        covariance=np.tile(np.eye(3), (len(things), 1, 1)),
    )


def _ids(map_: Map, vertices: IntArray, tracks: IntArray) -> IdArray:
    """Return ids of vertices and tracks; a track that shows two things from one vertex gives several."""
    known = {row.tobytes() for row in map_.landmarks.id}
    found = []
    for vertex, track in zip(map_.vertices.id[vertices], tracks.tolist(), strict=True):
        made = (derived_id(KIND, vertex.tobytes(), track, n) for n in count())
        found.append(next(each for each in made if each not in known))
        known.add(found[-1])
    return id_array(found)
