"""What holds each connected part of a map in place, where no measurement of the world does."""

from __future__ import annotations

import gtsam
import numpy as np

from mapstream.operators.estimation.fixing import fixed
from mapstream.operators.estimation.keys import variable_of
from mapstream.operators.estimation.noise import Factor
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_LEVEL_KINDS = ("imu", "gravity")  # they know where up is
_TIGHT = 1e4  # per rad and per m; it holds what nothing else does, so it costs nothing


def gauge_factors(
    map_: Map, factors: dict[int, Factor], links: IntArray | None = None
) -> list[Factor]:
    """Return factors that hold the oldest vertex of each part's best known mission.

    A part that is measured in the map's frame is not held. One that knows where up is keeps its tilt free.

    Args:
        map_: The map.
        factors: By row of its edges.
        links: Rows of vertices (N, 2) that something else joins, such as points that both saw.
    """
    rows = np.fromiter(factors, dtype=np.int64)
    parts = _parts(map_, factors, np.zeros((0, 2), np.int64) if links is None else links)
    kinds = map_.edges.kind[rows]
    vertex = map_.edges.vertex_a[rows]
    is_held = np.isin(parts, parts[vertex[_is_in_the_map(map_, rows) & (vertex >= 0)]])
    is_level = np.isin(parts, parts[vertex[np.isin(kinds, _LEVEL_KINDS) & (vertex >= 0)]])
    mission = map_.vertices.mission
    is_guess = ~map_.missions.is_base_frame_known[mission]
    order = np.lexsort((map_.vertices.stamp_ns, mission, is_guess))
    _, first = np.unique(parts[order], return_index=True)
    chosen = np.sort(order[first])
    chosen = chosen[~is_held[chosen]]
    return [
        _upright(key, pose) if is_level[key] else fixed(key, pose)
        for key, pose in zip(chosen.tolist(), map_.T_map_base(chosen), strict=True)
    ]


def _is_in_the_map(map_: Map, rows: IntArray) -> BoolArray:
    """Return which edges (N,) tie a part to the map's frame: absolute ones, in a frame whose place is known."""
    edges, known = map_.edges, np.append(map_.frames.is_known, True)  # -1 is the map frame itself
    is_absolute = np.isin(edges.kind[rows], ("absolute", "position", "fixed"))
    is_tied: BoolArray = is_absolute & known[edges.frame[rows]]
    return is_tied


def _parts(map_: Map, factors: dict[int, Factor], links: IntArray) -> IntArray:
    """Return the number of the connected part (N,) of each vertex; landmarks and outer frames connect, too."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    edges, num = map_.edges, len(map_.vertices)
    rows = np.fromiter(factors, dtype=np.int64)
    has_two = (edges.vertex_a[rows] >= 0) & (edges.vertex_b[rows] >= 0)
    pairs = [links, np.column_stack([edges.vertex_a[rows[has_two]], edges.vertex_b[rows[has_two]]])]
    node_of: dict[int, int] = {}
    for row in rows[~has_two].tolist():
        nodes = [_node(key, num, node_of) for key in factors[row].keys()]  # noqa: SIM118
        pairs.append(np.array([(nodes[0], node) for node in nodes[1:]], np.int64).reshape(-1, 2))
    ends = np.concatenate(pairs)
    size = num + len(node_of)
    joined = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(size, size))
    _, parts = connected_components(joined, directed=False)
    found: IntArray = parts[:num].astype(np.int64)
    return found


def _node(key: int, num_vertices: int, node_of: dict[int, int]) -> int:
    """Return a number for a variable: of poses their rows, of others what is free above them."""
    variable, row = variable_of(key)
    return row if variable == "pose" else node_of.setdefault(key, num_vertices + len(node_of))


def _upright(key: int, pose: FloatArray) -> Factor:
    """Return the factor that holds the position, and the heading about the map's z axis."""
    root = np.zeros((6, 6))
    root[0, :3] = _TIGHT * pose[2, :3]  # z of the map in the base
    root[3:, 3:] = _TIGHT * np.eye(3)
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)  # noqa: FBT003  # smart=False
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), noise)
