"""How a map grows by submaps: keyframes, edges, measurements, IMU samples, and what came late."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.build import add_edges, add_records, new_mission
from mapstream.recordings.maps.constraints import add_constraints
from mapstream.recordings.maps.features import add_features
from mapstream.recordings.maps.ids import id_array, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import ImuSamples, Vertices
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, RelativePose, Splice, Submap
from mapstream.streams.messages.sensors import ImuBatch

CONTINUOUS_KINDS = ("odometry", "wheel", "motion_model", "imu")
"""Edges that a source of motion gives for any interval, so that a new pose inside it splits them."""


def append_submap(map_: Map, submap: Submap, *, mission_name: str = "") -> Map:
    """Return the map with a submap's keyframes, edges, measurements and references.

    New rows come last in their tables, also those of vertices that splices put between older ones;
    `in_canonical_order` sorts them.
    The first keyframe of every submap but the first is the mission's newest vertex and is not added again.
    From there on odometry is carried on, so that the new vertices follow a mission that was optimised.

    Raises:
        MapError: If the submap is not the next one of its mission, or an edge ends outside the mission.
    """
    known = [map_.mission_id(row) for row in range(len(map_.missions))]
    if submap.mission_id not in known:
        map_ = new_mission(map_, submap.mission_id, name=mission_name, sensors=submap.sensors)
    mission_row = map_.mission_row(submap.mission_id)
    for splice in submap.splices:
        map_ = _spliced(map_, splice, mission_row)
    T_mission_odom = _continued(map_, mission_row, submap)
    added = submap.keyframes[1:] if len(map_.vertices_of(mission_row)) else submap.keyframes
    poses = T_mission_odom.matrix @ _stacked_poses(added)
    map_ = _with_vertices(map_, added, mission_row, poses)
    map_ = add_edges(map_, submap.edges)
    splice_edges = [edge for splice in submap.splices for edge in splice.edges]
    map_ = _with_samples(map_, [*submap.edges, *splice_edges], submap)
    constraints = [*submap.constraints, *(c for s in submap.splices for c in s.constraints)]
    return add_constraints(map_, submap.mission_id, constraints)


def _continued(map_: Map, mission_row: int, submap: Submap) -> SE3:
    """Return T_mission_odom by which the submap follows on what the map holds."""
    rows = map_.vertices_of(mission_row)
    first = submap.keyframes[0]
    if not len(rows):
        if submap.index != 0:
            where = f"submap {submap.index} of mission {submap.mission_id}"
            raise MapError(f"{where}: the map has no vertex of this mission; append submap 0 first")
        return SE3.identity()
    newest = int(rows[-1])
    stamp_ns = int(map_.vertices.stamp_ns[newest])
    if first.stamp_ns != stamp_ns:
        raise MapError(
            f"submap {submap.index} of mission {submap.mission_id} begins at {first.stamp_ns} ns,"
            f" but the mission ends at {stamp_ns} ns; append submaps in order, each once"
        )
    return map_.vertices.T_mission_base_of(newest) @ first.odometry.T_odom_base.inverse()


def _with_vertices(
    map_: Map, keyframes: Sequence[Keyframe], mission_row: int, T_mission_base: FloatArray
) -> Map:
    """Return the map with a vertex for each keyframe, at these poses (N, 4, 4), and its records."""
    mission = map_.missions.id[mission_row].tobytes()
    odometry = [keyframe.odometry for keyframe in keyframes]
    R_odom_base = _stacked_poses(keyframes)[:, :3, :3]
    R_mission_odom = T_mission_base[:, :3, :3] @ np.swapaxes(R_odom_base, 1, 2)
    velocity_odom = _stacked([o.velocity_mps for o in odometry])
    vertices = Vertices(
        id=id_array(vertex_id(mission, keyframe.stamp_ns) for keyframe in keyframes),
        mission=np.full(len(keyframes), mission_row),
        stamp_ns=np.array([keyframe.stamp_ns for keyframe in keyframes], dtype=np.int64),
        T_mission_base=T_mission_base,
        velocity_mps=(R_mission_odom @ velocity_odom[:, :, None])[:, :, 0],
        gyro_bias_radps=_stacked([o.gyro_bias_radps for o in odometry]),
        accel_bias_mps2=_stacked([o.accel_bias_mps2 for o in odometry]),
    )
    first_new = len(map_.vertices)
    map_ = replace(map_, vertices=concatenate([map_.vertices, vertices]))
    rows = [(first_new + at, keyframe) for at, keyframe in enumerate(keyframes)]
    map_ = add_records(map_, [(row, r) for row, keyframe in rows for r in keyframe.records])
    seen = [(row, keyframe.stamp_ns, f) for row, keyframe in rows for f in keyframe.features]
    return add_features(map_, mission_row, seen)


def _stacked_poses(keyframes: Sequence[Keyframe]) -> FloatArray:
    return np.array([k.odometry.T_odom_base.matrix for k in keyframes]).reshape(-1, 4, 4)


def _stacked(vectors: Iterable[FloatArray | None]) -> FloatArray:
    rows = [np.full(3, np.nan) if vector is None else vector for vector in vectors]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _spliced(map_: Map, splice: Splice, mission_row: int) -> Map:
    """Return the map with a vertex inside an interval whose continuous edges are split there.

    Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C, "pose splicing".
    """
    stamp_ns = splice.keyframe.stamp_ns
    rows = map_.vertices_of(mission_row)
    at = int(np.searchsorted(map_.vertices.stamp_ns[rows], stamp_ns))
    if at < len(rows) and map_.vertices.stamp_ns[rows[at]] == stamp_ns:
        raise MapError(f"a splice at {stamp_ns} ns: the mission has a vertex there already")
    before, after = rows[max(at - 1, 0)], rows[min(at, len(rows) - 1)]
    if 0 < at < len(rows):
        edges = map_.edges
        joins = (edges.vertex_a == before) & (edges.vertex_b == after)
        map_ = map_.select(edges=~(joins & np.isin(edges.kind, CONTINUOUS_KINDS)))
    pose = _pose_inside(map_, splice, int(before), int(after))
    map_ = _with_vertices(map_, [splice.keyframe], mission_row, pose.matrix[None])
    return add_edges(map_, splice.edges)


def _pose_inside(map_: Map, splice: Splice, before: int, after: int) -> SE3:
    """Return where a measured motion from the vertex before or to the one after puts the new vertex."""
    T_before, T_after = map(map_.vertices.T_mission_base_of, (before, after))
    for edge in splice.edges:
        if edge.kind != "imu" and edge.stamp_b_ns == splice.keyframe.stamp_ns:
            return T_before @ edge.T_a_b
    for edge in splice.edges:
        if edge.kind != "imu":
            return T_after @ edge.T_a_b.inverse()
    start_ns, end_ns = map_.vertices.stamp_ns[[before, after]].tolist()
    fraction = (splice.keyframe.stamp_ns - start_ns) / max(end_ns - start_ns, 1)
    return T_before.interpolate(T_after, float(np.clip(fraction, 0, 1)))


def _with_samples(map_: Map, edges: Sequence[RelativePose], submap: Submap) -> Map:
    """Return the map with the raw samples of edges of kind imu, one beyond each end where it is there.

    Raises:
        MapError: If an edge of kind imu has no samples.
    """
    inertial = [edge for edge in edges if edge.kind == "imu"]
    if not inertial:
        return map_
    if submap.imu is None:
        raise MapError(f"submap {submap.index} of mission {submap.mission_id}: no IMU samples")
    starts, ends = (
        map_.vertex_rows(submap.mission_id, stamps_ns).tolist()
        for stamps_ns in ([e.stamp_a_ns for e in inertial], [e.stamp_b_ns for e in inertial])
    )
    table = map_.edges
    row_of = {
        (int(table.vertex_a[row]), int(table.vertex_b[row])): row
        for row in map_.edges_of("imu").tolist()
    }
    pairs = zip(starts, ends, inertial, strict=True)  # a splice may have split one of them
    cut = [(row_of[a, b], _enclosing(submap.imu, e)) for a, b, e in pairs if (a, b) in row_of]
    added = ImuSamples(
        edge=np.concatenate([np.full(kept.stop - kept.start, row) for row, kept in cut]),
        stamp_ns=np.concatenate([submap.imu.stamps_ns[kept] for _, kept in cut]),
        gyro_radps=np.concatenate([submap.imu.gyro_radps[kept] for _, kept in cut]),
        accel_mps2=np.concatenate([submap.imu.accel_mps2[kept] for _, kept in cut]),
    )
    return replace(map_, imu=concatenate([map_.imu, added]))


def _enclosing(imu: ImuBatch, edge: RelativePose) -> slice:
    """Return the samples from the last one up to the edge's start to the first one at its end."""
    first = int(np.searchsorted(imu.stamps_ns, edge.stamp_a_ns, side="right")) - 1
    last = int(np.searchsorted(imu.stamps_ns, edge.stamp_b_ns, side="left"))
    return slice(max(first, 0), min(last + 1, len(imu.stamps_ns)))
