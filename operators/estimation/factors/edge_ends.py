"""What edges are called in messages, and whether they end where their kind needs it."""

from __future__ import annotations

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import EstimationError


def edge_name(map_: Map, row: int) -> str:
    """Return how messages call an edge."""
    edges = map_.edges
    source = f" of {edges.source[row]}" if edges.source[row] else ""
    vertex = int(edges.vertex_a[row])
    where = f" at {map_.vertices.stamp_ns[vertex]} ns" if vertex >= 0 else ""
    return f"edge {row} ({edges.kind[row]}{source}){where}"


def require_ends(map_: Map, rows: IntArray, *columns: str) -> None:
    """Check that edges have ends in these columns.

    Raises:
        EstimationError: If one has not.
    """
    for column in columns:
        missing = rows[getattr(map_.edges, column)[rows] < 0]
        if len(missing):
            raise EstimationError(f"{edge_name(map_, int(missing[0]))} needs a {column}")
