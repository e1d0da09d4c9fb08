"""Where an optimisation of poses may begin: by relaxation of the rotations, which needs no start itself.

Source: Carlone et al., Initialization Techniques for 3D SLAM, ICRA 2015; in the plane a rotation is a complex
number, so that the relaxation is one sparse system (Martinec and Pajdla, CVPR 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from mapstream.operators.estimation.fixing import fixed
from mapstream.operators.estimation.keys import variable_of
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.problem import Problem, graph_of
from mapstream.operators.estimation.states import Values, initial_values
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert

_PLANAR = [2, 3, 4]  # yaw, x, y among the six directions
_TINY = 1e-12  # of the largest weight; it keeps poses that nothing places from being singular
ComplexArray = npt.NDArray[np.complex128]


def chordal_map(problem: Problem, loops: IntArray) -> Map:
    """Return the map with poses from its relative measurements alone, of which these loops are true."""
    map_ = problem.map
    rows = np.array([*problem.plain, *loops.tolist()], dtype=np.int64)
    rows = rows[(map_.edges.vertex_a[rows] >= 0) & (map_.edges.vertex_b[rows] >= 0)]
    rows = rows[map_.edges.kind[rows] != "imu"]
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    held = _with_one_of_each_part(map_, rows, np.array(sorted(_held_poses(problem)), np.int64))
    if _is_planar(map_, poses, rows):
        poses = _planar(map_, poses, rows, held)
    else:
        poses = _spatial(problem, rows, held, poses)
    frames = map_.missions.T_map_mission[map_.vertices.mission]
    return with_poses(map_, np.arange(len(poses)), invert(frames) @ poses)


def chordal_values(problem: Problem, loops: IntArray) -> Values:
    """Return values with chordal poses; other variables follow them."""
    return initial_values(chordal_map(problem, loops), problem.values.keys())


def _held_poses(problem: Problem) -> dict[int, Factor]:
    """Return what ties a pose to the map frame, by key of the pose."""
    absolute = [f for row, f in problem.plain.items() if problem.map.edges.vertex_b[row] < 0]
    ties = [f for f in (*problem.held, *absolute) if isinstance(f, gtsam.PriorFactorPose3)]
    return {f.keys()[0]: f for f in ties if variable_of(f.keys()[0])[0] == "pose"}


def _with_one_of_each_part(map_: Map, rows: IntArray, held: IntArray) -> IntArray:
    """Return the held poses, and the first of each part that the edges connect and that holds none."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    a, b, num = map_.edges.vertex_a[rows], map_.edges.vertex_b[rows], len(map_.vertices)
    links = coo_array((np.ones(len(rows)), (a, b)), shape=(num, num))
    _, part = connected_components(links, directed=False)
    _, first = np.unique(part, return_index=True)
    return np.concatenate([held, first[~np.isin(part[first], part[held])]])


def _is_planar(map_: Map, poses: FloatArray, rows: IntArray) -> bool:
    third = np.concatenate([poses, map_.edges.T_a_b[rows]])[:, 2]
    return bool(np.allclose(third, [0, 0, 1, 0], rtol=0, atol=1e-9))


def _planar(map_: Map, poses: FloatArray, rows: IntArray, held: IntArray) -> FloatArray:
    """Return poses (N, 4, 4): headings as complex numbers of any length, then positions."""
    edges, flat = map_.edges, map_.edges.covariance[rows][:, _PLANAR][:, :, _PLANAR]
    a, b = edges.vertex_a[rows], edges.vertex_b[rows]
    turn = edges.T_a_b[rows, 0, 0] + 1j * edges.T_a_b[rows, 1, 0]
    step = edges.T_a_b[rows, 0, 3] + 1j * edges.T_a_b[rows, 1, 3]
    known = poses[held, 0, 0] + 1j * poses[held, 1, 0]
    heading = _solved(_Links(a, b, turn, np.zeros(len(rows)), 1 / flat[:, 0, 0]), held, known)
    heading /= np.maximum(np.abs(heading), 1e-12)
    weights = 2 / (flat[:, 1, 1] + flat[:, 2, 2])
    known = poses[held, 0, 3] + 1j * poses[held, 1, 3]
    ones = np.ones(len(rows), dtype=complex)
    place = _solved(_Links(a, b, ones, heading[a] * step, weights), held, known)
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, 0, 0] = result[:, 1, 1] = heading.real
    result[:, 1, 0], result[:, 0, 1] = heading.imag, -heading.imag
    result[:, 0, 3], result[:, 1, 3] = place.real, place.imag
    return result


@dataclass(frozen=True, slots=True)
class _Links:
    """x_b = turn x_a + offset, each with a weight."""

    a: IntArray
    b: IntArray
    turn: ComplexArray
    offset: npt.NDArray[np.generic]
    weight: FloatArray


def _solved(links: _Links, held: IntArray, known: ComplexArray) -> ComplexArray:
    """Return the least squares solution where some unknowns are known."""
    from scipy import sparse  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    num, size = len(links.a), int(max(links.a.max(), links.b.max(), held.max(initial=0))) + 1
    rows = np.arange(num)
    entries = np.concatenate([-links.turn, np.ones(num)])
    places = (np.concatenate([rows, rows]), np.concatenate([links.a, links.b]))
    system = sparse.coo_array((entries, places), shape=(num, size)).tocsc()
    is_free = np.ones(size, dtype=bool)
    is_free[held] = False
    found = np.zeros(size, dtype=np.complex128)
    found[held] = known
    right = links.offset - system @ found
    free = system[:, np.flatnonzero(is_free)]
    weighted = free.conj().T @ sparse.diags_array(links.weight)
    normal = (weighted @ free).tocsc()
    normal += _TINY * links.weight.max() * sparse.eye_array(normal.shape[0], format="csc")
    found[is_free] = splu(normal).solve(weighted @ right)
    return found


def _spatial(problem: Problem, rows: IntArray, held: IntArray, poses: FloatArray) -> FloatArray:
    """Return poses (N, 4, 4) by gtsam, which weighs all measurements alike."""
    alike = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)  # it takes no other kind of noise
    factors = {**problem.plain, **problem.loops}
    known = _held_poses(problem)
    ties = [known.get(key) or fixed(key, poses[key]) for key in held.tolist()]
    chosen = [*ties, *(factors[row] for row in rows.tolist())]
    graph = graph_of([factor.cloneWithNewNoiseModel(alike) for factor in chosen])
    values = gtsam.InitializePose3.initialize(graph)
    result = poses.copy()
    keys = np.array(list(values.keys()), dtype=np.int64)
    found = gtsam.utilities.extractPose3(values)  # (M, 12) in the order of keys
    result[keys, :3, :3] = found[:, :9].reshape(-1, 3, 3)
    result[keys, :3, 3] = found[:, 9:]
    return result
