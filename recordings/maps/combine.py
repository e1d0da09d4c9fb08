"""Maps put together, and parts of maps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.columns import IdArray
from mapstream.recordings.maps.ids import as_keys
from mapstream.recordings.maps.model import TABLES, Map, from_tables
from mapstream.recordings.maps.rows import concatenate, shifted
from mapstream.recordings.maps.tables import Journal
from mapstream.streams.arrays import BoolArray
from mapstream.streams.errors import MapError


def select_missions(map_: Map, mission_ids: Sequence[str]) -> Map:
    """Return the map with these missions alone; edges to others go, and what none of them uses.

    That is outer frames, and projections of kinds of features.

    Raises:
        MapError: If the map has no such mission.
    """
    keep = np.zeros(len(map_.missions), dtype=bool)
    keep[[map_.mission_row(mission_id) for mission_id in mission_ids]] = True
    chosen = map_.select(missions=keep)
    used = np.isin(np.arange(len(chosen.frames)), chosen.edges.frame)
    learnt = np.isin(chosen.projections.kind.astype(str), chosen.feature_sets.kind.astype(str))
    return chosen.select(frames=used, projections=learnt)


def merge_maps(maps: Sequence[Map], *, share_frame: bool = False) -> Map:
    """Return one map with the missions of all.

    Each map has a frame of its own: unless they share one, missions of the second map and of those after
    it keep their place as a guess that is not known, until something anchors them.
    Of regions of one name and kind the earlier map's counts.

    Raises:
        MapError: If two maps hold the same mission.
    """
    merged = Map.empty()
    for number, map_ in enumerate(maps):
        added = map_ if share_frame or number == 0 else _unanchored(map_)
        _refuse_common_missions(merged, added)
        num_rows = {name: len(table) for name, table in merged.tables().items()}
        pairs = zip(TABLES, merged.tables().values(), added.tables().values(), strict=True)
        merged = from_tables(
            {name: concatenate([old, shifted(new, num_rows)]) for name, old, new in pairs}
        )
    merged = merged.select(
        projections=_is_first(merged.projections.id), regions=_is_first(merged.regions.id)
    )
    return _with_each_frame_once(merged)


def _is_first(ids: IdArray) -> BoolArray:
    """Return which rows (N,) have an id that no earlier one has."""
    first = np.unique(as_keys(ids), return_index=True)[1]
    return np.isin(np.arange(len(ids)), first)


def _with_each_frame_once(map_: Map) -> Map:
    """Return the map without repetitions of outer frames; what referred to one refers to the first."""
    _, first, number = np.unique(as_keys(map_.frames.id), return_index=True, return_inverse=True)
    if len(first) == len(map_.frames):
        return map_
    frame = map_.edges.frame
    is_outer = frame >= 0
    shared = frame.copy()
    shared[is_outer] = first[number[frame[is_outer]]]
    map_ = replace(map_, edges=replace(map_.edges, frame=shared))
    return map_.select(frames=np.isin(np.arange(len(map_.frames)), first))


def _unanchored(map_: Map) -> Map:
    unknown = np.zeros(len(map_.missions), dtype=bool)
    return replace(map_, missions=replace(map_.missions, is_base_frame_known=unknown))


def _refuse_common_missions(a: Map, b: Map) -> None:
    common = np.intersect1d(as_keys(a.missions.id), as_keys(b.missions.id))
    if len(common):
        names = [key.tobytes().hex() for key in common]
        raise MapError(
            f"both maps hold mission {names}; leave it out of one of them before merging"
        )


def with_journal_entry(map_: Map, operation: str, **parameters: object) -> Map:
    """Return the map with a note of what was done to it; parameters must be JSON values."""
    entry = Journal(
        operation=np.array([operation], dtype=object),
        parameters=np.array([json.dumps(parameters, sort_keys=True)], dtype=object),
    )
    return replace(map_, journal=concatenate([map_.journal, entry]))
