"""Small maps of objects that a robot saw on one or several visits, straight from where they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.features import add_features
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges, Landmarks, Vertices
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.vision import ImageFeatures

MISSION = "5e" * 16
OTHER = "07" * 16


@dataclass(frozen=True)
class Visit:
    """What a robot sees while it stands in a few places; every image shows everything."""

    labels: list[str]
    points: FloatArray  # (N, 3) of the objects, where the map has them
    eyes: FloatArray  # (V, 3) of the robot, where the map has it
    start_s: float = 0.0
    mission: str = MISSION
    descriptors: Float32Array | None = None  # (N, D)
    sigma_m: float = 0.03


def square(start: FloatArray) -> FloatArray:
    """Return where a robot stands that looks at a room from a corner of it."""
    steps = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0.4, 0], [0, 0.4, 0]])
    places: FloatArray = start + steps
    return places


def map_of(*visits: Visit) -> Map:
    """Return a map of visits, joined by odometry, with a landmark for each object of each."""
    map_ = Map.empty()
    for visit in visits:
        map_ = _with(map_, visit)
    return map_


def moved(T: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) after a motion (4, 4)."""
    there: FloatArray = points @ T[:3, :3].T + T[:3, 3]
    return there


def _with(map_: Map, visit: Visit) -> Map:
    if visit.mission not in [map_.mission_id(row) for row in range(len(map_.missions))]:
        map_ = new_mission(map_, visit.mission)
    mission, first = map_.mission_row(visit.mission), len(map_.vertices)
    before = map_.vertices_of(mission)[-1:]
    stamps_ns = (np.arange(len(visit.eyes)) + round(visit.start_s)) * 1_000_000_000
    poses = np.tile(np.eye(4), (len(visit.eyes), 1, 1))
    poses[:, :3, 3] = visit.eyes
    added = Vertices(
        id=vertex_ids(visit.mission, stamps_ns),
        mission=np.full(len(poses), mission),
        stamp_ns=stamps_ns,
        T_mission_base=poses,
    )
    map_ = replace(map_, vertices=concatenate([map_.vertices, added]))
    ends = np.concatenate([before, first + np.arange(len(poses))])
    T = map_.vertices.T_mission_base
    steps = Edges(
        kind=np.full(len(ends) - 1, "odometry", object),
        vertex_a=ends[:-1],
        vertex_b=ends[1:],
        T_a_b=invert(T[ends[:-1]]) @ T[ends[1:]],
        covariance=np.tile(np.diag([0.02**2] * 3 + [0.1**2] * 3), (len(ends) - 1, 1, 1))
        * np.where(np.arange(len(ends) - 1) < len(before), 100.0, 1.0)[:, None, None],
        source=np.full(len(ends) - 1, "import", object),
    )
    map_ = append_edges(map_, steps)
    return _with_landmarks(map_, visit, first, mission)


def _with_landmarks(map_: Map, visit: Visit, first: int, mission: int) -> Map:
    num, base = len(visit.labels), len(map_.landmarks)
    names = [derived_id("made", visit.mission, str(visit.start_s), n) for n in range(num)]
    added = Landmarks(
        id=id_array(names),
        kind=np.full(num, "object", object),
        label=np.array(visit.labels, object),
        vertex=np.full(num, first),
        p_base=visit.points - visit.eyes[0],
        covariance=np.tile(visit.sigma_m**2 * np.eye(3), (num, 1, 1)),
    )
    map_ = replace(map_, landmarks=concatenate([map_.landmarks, added]))
    shown = [(n, row) for row in range(len(visit.eyes)) for n in range(num)]
    seen = []
    for n, row in shown:
        none = np.empty((1, 0), np.float32)
        descriptor = none if visit.descriptors is None else visit.descriptors[n : n + 1]
        features = ImageFeatures(
            stamp_ns=int(map_.vertices.stamp_ns[first + row]),
            kind="object",
            frame="camera",
            keypoints_px=np.zeros((1, 2), np.float32),
            track_ids=np.array([base + n]),
            descriptors=descriptor,
        )
        seen.append((first + row, features.stamp_ns, features))
    old = len(map_.observations)
    map_ = add_features(map_, mission, seen)
    landmark = map_.observations.landmark.copy()
    landmark[old:] = [base + n for n, _ in shown]
    return replace(map_, observations=replace(map_.observations, landmark=landmark))
