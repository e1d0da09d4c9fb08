"""Maps that were made apart, as one: what several of them hold, by its id, is there once.

A mission may be in several maps as a whole, or in parts that share a vertex, such as submaps.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D (merging of missions and submaps).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.maps.joining import NoCommonVertexError, following
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.columns import IdArray, references_of
from mapstream.recordings.maps.combine import select_missions
from mapstream.recordings.maps.ids import as_keys
from mapstream.recordings.maps.model import TABLES, Map, from_tables
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.rows import concatenate, shifted, table_digest
from mapstream.recordings.maps.semantic_tables import Regions
from mapstream.recordings.maps.tables import Frames, Journal, Projections
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert

_WITH_IDS = (
    "missions", "frames", "vertices", "landmarks", "edges", "regions", "resources", "projections"
)  # fmt: skip
_PARTS = (
    ("imu", "edge"),
    ("feature_sets", "vertex"),
    ("observations", "vertex"),
)  # go with what they are a part of


class MergeConfig(OperatorConfig):
    """How maps come together."""

    has_common_frame: bool = False
    """The maps share a map frame. Else only a mission that two maps hold tells how they lie."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeReport:
    """What came together."""

    num_missions: int
    num_vertices: int
    repeated: tuple[str, ...]  # ids of missions that several maps held
    joined: tuple[str, ...] = ()  # those of them of which the maps held different parts


def merge(maps: Sequence[Map], config: MergeConfig | None = None) -> tuple[Map, MergeReport]:
    """Return one map with the missions of all; the first map's frame is the map frame.

    A mission that is in several maps with the same content is there once, and places the others of its map.
    Parts of a mission follow on each other, in any order of the maps; where both are, the earlier map's states count.
    Missions of maps without a known place keep it as a guess, until something anchors them.
    Of regions of one name and kind that several maps have, the earlier map's counts.

    Raises:
        MapError: If two maps hold one mission with different content where both are, or parts of one that share no
            vertex, or one outer frame with two origins.
    """
    config = config or MergeConfig()
    merged, repeated, joined = Map.empty(), list[str](), list[str]()
    waiting, passed_over = list(maps), 0
    while waiting:
        map_ = waiting.pop(0)
        try:
            placed, common, parts = _fitted(map_, merged, config)
        except NoCommonVertexError:
            passed_over += 1
            if passed_over > len(waiting):
                raise
            waiting.append(map_)
            continue
        passed_over = 0
        merged = _with_each_row_once(_stacked(merged, placed))
        repeated += common
        joined += parts
    if joined:
        merged = in_canonical_order(merged)  # parts may have come in any order
    return merged, MergeReport(
        num_missions=len(merged.missions),
        num_vertices=len(merged.vertices),
        repeated=tuple(repeated),
        joined=tuple(joined),
    )


def _fitted(map_: Map, merged: Map, config: MergeConfig) -> tuple[Map, list[str], list[str]]:
    """Return a map as it lies beside another one, the missions that both hold, and those with different parts."""
    keys = np.intersect1d(as_keys(merged.missions.id), as_keys(map_.missions.id))
    common = [key.tobytes().hex() for key in keys]
    parts = [mission_id for mission_id in common if _is_part(merged, map_, mission_id)]
    for mission_id in parts:
        map_ = following(map_, merged, mission_id)
    _require_same_frames(merged.frames, map_.frames)
    if len(merged.missions) and not config.has_common_frame:
        map_ = _placed(map_, merged, common)
    return map_, common, parts


def _stacked(a: Map, b: Map) -> Map:
    """Return the rows of both maps."""
    num_rows = {name: len(table) for name, table in a.tables().items()}
    pairs = zip(TABLES, a.tables().values(), b.tables().values(), strict=True)
    return from_tables({n: concatenate([old, shifted(new, num_rows)]) for n, old, new in pairs})


def _is_part(a: Map, b: Map, mission_id: str) -> bool:
    """Return whether two maps hold different parts of a mission; else they hold the same.

    Raises:
        MapError: If they have the same vertices, and something else differs.
    """
    stamps_ns = [m.vertices.stamp_ns[m.vertices_of(m.mission_row(mission_id))] for m in (a, b)]
    if not np.array_equal(stamps_ns[0], stamps_ns[1]):
        return True
    contents = zip(_content(a, mission_id).items(), _content(b, mission_id).values(), strict=True)
    differing = [name for (name, left), right in contents if left != right]
    if differing:
        raise MapError(
            f"mission {mission_id} is in two maps, and its {', '.join(differing)} differ;"
            " remove it from one of them before merging"
        )
    return False


def _content(map_: Map, mission_id: str) -> dict[str, bytes]:
    """Return a hash by table of what a mission holds, wherever it lies, in any order of rows."""
    alone = in_canonical_order(select_missions(map_, [mission_id]))
    missions = replace(
        alone.missions,
        name=np.array([""], dtype=object),
        T_map_mission=np.eye(4)[None],
        is_base_frame_known=np.array([False]),
    )
    alone = replace(
        alone,
        missions=missions,
        frames=Frames(),
        regions=Regions(),  # what people call places is no part of a mission
        projections=Projections(),
        journal=Journal(),
    )
    return {name: table_digest(table) for name, table in alone.tables().items()}


def _require_same_frames(a: Frames, b: Frames) -> None:
    """Refuse outer frames of one name with other origins: their measurements would not agree.

    Raises:
        MapError: If there are such frames.
    """
    _, rows_a, rows_b = np.intersect1d(as_keys(a.id), as_keys(b.id), return_indices=True)
    for i, j in zip(rows_a, rows_b, strict=True):
        same_origin = np.array_equal(a.origin_lla[i], b.origin_lla[j], equal_nan=True)
        if a.crs[i] != b.crs[j] or not same_origin:
            raise MapError(
                f"outer frame {a.name[i]!r} has origin {a.origin_lla[i].tolist()} {a.crs[i]!r} in one map"
                f" and {b.origin_lla[j].tolist()} {b.crs[j]!r} in another; map them with one origin"
            )


def _placed(added: Map, merged: Map, common: Sequence[str]) -> Map:
    """Return a map in the frame of another one, by a mission whose place both know; else as a guess."""
    missions, frames = added.missions, added.frames
    for mission_id in common:
        here, there = added.mission_row(mission_id), merged.mission_row(mission_id)
        if missions.is_base_frame_known[here] and merged.missions.is_base_frame_known[there]:
            T_map_mission = merged.missions.T_map_mission[there]
            T_merged_added = T_map_mission @ invert(missions.T_map_mission[here])
            return replace(
                added,
                missions=replace(missions, T_map_mission=T_merged_added @ missions.T_map_mission),
                frames=replace(frames, T_map_frame=T_merged_added @ frames.T_map_frame),
            )
    return replace(
        added,
        missions=replace(missions, is_base_frame_known=np.zeros(len(missions), dtype=bool)),
        frames=replace(frames, is_known=np.zeros(len(frames), dtype=bool)),
    )


def _with_each_row_once(map_: Map) -> Map:
    """Return the map without rows whose id is that of an earlier one; what referred to them refers to that."""
    stands_for, keep = dict[str, IntArray](), dict[str, BoolArray]()
    for name in _WITH_IDS:
        ids: IdArray = map_.tables()[name].id  # type: ignore[attr-defined]  # these have ids
        _, first, number = np.unique(as_keys(ids), return_index=True, return_inverse=True)
        stands_for[name] = np.append(first[number], -1)  # the last is that of no row
        keep[name] = first[number] == np.arange(len(ids))
    tables = map_.tables()
    for name, table in tables.items():
        redirected = {
            column.name: stands_for[str(column.refers_to)][getattr(table, column.name)]
            for column in references_of(type(table))
            if column.refers_to in _WITH_IDS and (name, column.name) not in _PARTS
        }
        tables[name] = replace(table, **redirected) if redirected else table
    return from_tables(tables).select(**keep)
