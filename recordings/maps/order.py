"""One order of rows for what a map holds, so that it does not tell in which order things came."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.columns import references_of
from mapstream.recordings.maps.ids import as_keys
from mapstream.recordings.maps.model import Map, from_tables
from mapstream.recordings.maps.rows import take
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import IntArray


def in_canonical_order(map_: Map) -> Map:
    """Return the map with vertices by mission and stamp, and all else by what it belongs to and holds.

    Missions keep their order, since the first one of a map defines its frame.
    """
    vertices = map_.vertices
    map_ = _with_rows(map_, "vertices", np.lexsort((vertices.stamp_ns, vertices.mission)))
    map_ = _with_rows(map_, "frames", np.argsort(map_.frames.name.astype(str), kind="stable"))
    map_ = _with_rows(map_, "landmarks", np.argsort(as_keys(map_.landmarks.id), kind="stable"))
    map_ = _with_rows(map_, "edges", _by_content(map_.edges))
    map_ = append_edges(replace(map_, edges=Edges()), map_.edges)  # ids of alike edges count anew
    map_ = _with_rows(map_, "imu", np.lexsort((map_.imu.stamp_ns, map_.imu.edge)))
    sets = map_.feature_sets
    by_image = np.lexsort((sets.kind.astype(str), sets.sensor.astype(str), sets.vertex))
    map_ = _with_rows(map_, "feature_sets", by_image)
    seen = map_.observations
    by_feature = np.lexsort((seen.feature, seen.feature_set, seen.vertex))
    map_ = _with_rows(map_, "observations", by_feature)
    map_ = _with_rows(map_, "detections", np.argsort(map_.detections.observation, kind="stable"))
    map_ = _with_rows(map_, "regions", np.argsort(as_keys(map_.regions.id), kind="stable"))
    return _with_rows(map_, "resources", np.argsort(map_.resources.vertex, kind="stable"))


def _by_content(edges: Edges) -> IntArray:
    """Return the rows in an order that the edges alone determine."""

    def key(row: int) -> tuple[object, ...]:
        ends = [int(column[row]) for column in columns]
        values = (edges.T_a_b[row].tobytes(), edges.covariance[row].tobytes())
        return (*ends, edges.kind[row], edges.source[row], *values, edges.payload[row])

    columns = (edges.vertex_a, edges.vertex_b, edges.landmark_a, edges.landmark_b, edges.frame)
    return np.array(sorted(range(len(edges)), key=key), dtype=np.int64)


def _with_rows(map_: Map, name: str, order: npt.NDArray[np.integer[Any]]) -> Map:
    """Return the map with the rows of one table in another order, and references that follow them."""
    tables = map_.tables()
    if np.array_equal(order, np.arange(len(order))):
        return map_
    new_row = np.empty(len(order), dtype=np.int64)
    new_row[order] = np.arange(len(order))
    tables[name] = take(tables[name], order)
    for other, table in tables.items():
        columns = [c.name for c in references_of(type(table)) if c.refers_to == name]
        moved = {column: _followed(getattr(table, column), new_row) for column in columns}
        tables[other] = replace(table, **moved) if moved else table
    return from_tables(tables)


def _followed(rows: IntArray, new_row: IntArray) -> IntArray:
    return np.where(rows < 0, rows, np.append(new_row, -1)[rows])
