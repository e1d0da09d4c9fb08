"""A map: missions, their vertices, edges, landmarks and observations, as one immutable value.

An edit is a new map that shares the tables it did not touch, so readers need no lock and undo is free.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.columns import Table
from mapstream.recordings.maps.ids import as_keys, id_array, id_bytes, vertex_id
from mapstream.recordings.maps.rows import select, table_digest
from mapstream.recordings.maps.semantic_tables import Detections, Regions
from mapstream.recordings.maps.tables import (
    Edges,
    FeatureSets,
    Frames,
    ImuSamples,
    Journal,
    Landmarks,
    Missions,
    Observations,
    Projections,
    Resources,
    Vertices,
)
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import rotation_from_quat_xyzw
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Map:
    """Tables that refer to each other by row; each comes after those that it refers to."""

    missions: Missions = field(default_factory=Missions)
    frames: Frames = field(default_factory=Frames)
    vertices: Vertices = field(default_factory=Vertices)
    landmarks: Landmarks = field(default_factory=Landmarks)
    edges: Edges = field(default_factory=Edges)
    imu: ImuSamples = field(default_factory=ImuSamples)
    feature_sets: FeatureSets = field(default_factory=FeatureSets)
    observations: Observations = field(default_factory=Observations)
    detections: Detections = field(default_factory=Detections)
    regions: Regions = field(default_factory=Regions)
    resources: Resources = field(default_factory=Resources)
    projections: Projections = field(default_factory=Projections)
    journal: Journal = field(default_factory=Journal)

    @classmethod
    def empty(cls) -> Map:
        return cls()

    @property
    def stamp_ns(self) -> int:
        """The newest vertex's time; 0 of a map without vertices."""
        return int(self.vertices.stamp_ns.max(initial=0))

    def tables(self) -> dict[str, Table]:
        """Return the tables by name."""
        return {name: getattr(self, name) for name in TABLES}

    def digest(self) -> str:
        """Return 64 hex digits that are equal for maps that hold the same."""
        digest = hashlib.blake2b(digest_size=32)
        for name, table in self.tables().items():
            digest.update(name.encode() + table_digest(table))
        return digest.hexdigest()

    def select(self, **keep: BoolArray) -> Map:
        """Return the map with the rows where the masks are true, less all that refers to dropped rows.

        Masks are named for tables: `map.select(vertices=map.vertices.stamp_ns < end_ns)`.
        """
        return from_tables(select(self.tables(), keep))

    def mission_row(self, mission_id: str) -> int:
        """Return the row of the mission with these 32 hex digits.

        Raises:
            MapError: If the map has no such mission.
        """
        rows = np.flatnonzero(
            as_keys(self.missions.id) == as_keys(id_array([id_bytes(mission_id)]))
        )
        if not len(rows):
            known = [row.tobytes().hex() for row in self.missions.id]
            raise MapError(f"no mission {mission_id} in this map; it has {known}")
        return int(rows[0])

    def mission_id(self, row: int) -> str:
        """Return the 32 hex digits that name the mission in this row."""
        return bytes(self.missions.id[row]).hex()

    def vertices_of(self, mission_row: int) -> IntArray:
        """Return the rows of a mission's vertices in the order of their stamps."""
        rows = np.flatnonzero(self.vertices.mission == mission_row)
        return rows[np.argsort(self.vertices.stamp_ns[rows], kind="stable")]

    def vertex_rows(self, mission_id: str, stamps_ns: npt.ArrayLike) -> IntArray:
        """Return the rows of a mission's vertices at exactly these stamps (N,).

        Raises:
            MapError: If there is no vertex at a stamp.
        """
        query = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        rows = self.vertices_of(self.mission_row(mission_id))
        stamps = self.vertices.stamp_ns[rows]
        at = np.searchsorted(stamps, query)
        missing = np.append(stamps, -1)[at] != query
        if missing.any():
            stamp_ns = query[missing][0]
            raise MapError(f"mission {mission_id} has no vertex at {stamp_ns} ns")
        return rows[at]

    def edges_of(self, kind: str) -> IntArray:
        """Return the rows of all edges of one kind."""
        return np.flatnonzero(self.edges.kind == kind)

    def T_map_landmark(self, landmark_rows: npt.NDArray[np.integer[Any]]) -> FloatArray:
        """Return poses (N, 4, 4) of landmarks in the map frame; a point's axes are those of its base."""
        quat = self.landmarks.quat_base_xyzw[landmark_rows]
        T_base_landmark = np.tile(np.eye(4), (len(quat), 1, 1))
        is_turned = np.isfinite(quat).all(axis=1)
        T_base_landmark[is_turned, :3, :3] = rotation_from_quat_xyzw(quat[is_turned])
        T_base_landmark[:, :3, 3] = self.landmarks.p_base[landmark_rows]
        return self.T_map_base(self.landmarks.vertex[landmark_rows]) @ T_base_landmark

    def T_map_base(self, vertex_rows: npt.NDArray[np.integer[Any]]) -> FloatArray:
        """Return poses (N, 4, 4) of vertices in the map frame, as good as their missions' anchoring."""
        missions = self.vertices.mission[vertex_rows]
        poses: FloatArray = (
            self.missions.T_map_mission[missions] @ self.vertices.T_mission_base[vertex_rows]
        )
        return poses

    def trajectory(self, mission_id: str) -> Trajectory:
        """Return a mission's poses in the mission frame."""
        rows = self.vertices_of(self.mission_row(mission_id))
        stamps_ns, poses = self.vertices.stamp_ns[rows], self.vertices.T_mission_base[rows]
        return Trajectory(stamps_ns=stamps_ns, poses=poses)


TABLES: dict[str, type[Table]] = {
    each.name: cast(type[Table], each.default_factory) for each in fields(Map)
}


def from_tables(tables: Mapping[str, Table]) -> Map:
    """Return the map of these tables by name."""
    return Map(**cast(dict[str, Any], dict(tables)))


def vertex_ids(mission_id: str, stamps_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Return the ids (N, 16) of a mission's vertices at stamps (N,)."""
    mission = id_bytes(mission_id)
    return id_array(vertex_id(mission, int(stamp_ns)) for stamp_ns in stamps_ns)
