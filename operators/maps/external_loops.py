"""Loop closures that others found, as edges between the vertices nearest to their instants.

The way from an instant to its vertex is that of the odometry, so that the edge says what was measured:
T_va_vb = T_va_a T_a_b T_b_vb. Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.maps.composing import Motion
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import LoopClosure
from mapstream.streams.messages.estimates import RelativePose
from mapstream.streams.trajectory import Trajectory

_UNITS = {10**9: "seconds", 10**6: "milliseconds", 10**3: "microseconds"}


@dataclass(frozen=True, slots=True)
class End:
    """One end of a loop: the vertex nearest to it in time, and the way from there."""

    mission_id: str
    vertex_ns: int
    T_vertex_stamp: SE3


def end_at(mission_id: str, vertices: Trajectory, stamp_ns: int) -> End:
    """Return the end of a loop at an instant of a mission; of two vertices equally near, the earlier.

    Raises:
        MapError: If the instant lies before the mission's first vertex or after its last.
    """
    if not vertices.covers(stamp_ns):
        raise MapError(
            f"{stamp_ns} ns lies outside mission {mission_id}{_span(vertices, stamp_ns)}"
        )
    stamps_ns = vertices.stamps_ns
    at = min(int(np.searchsorted(stamps_ns, stamp_ns)), len(stamps_ns) - 1)
    if at and stamp_ns - stamps_ns[at - 1] <= stamps_ns[at] - stamp_ns:
        at -= 1
    vertex_ns = int(stamps_ns[at])
    return End(mission_id, vertex_ns, vertices.between(vertex_ns, stamp_ns))


def _span(vertices: Trajectory, stamp_ns: int) -> str:
    if not len(vertices):
        return ", which has no vertices"
    first_ns, last_ns = int(vertices.stamps_ns[0]), int(vertices.stamps_ns[-1])
    units = (unit for factor, unit in _UNITS.items() if first_ns <= stamp_ns * factor <= last_ns)
    unit = next(units, None)
    hint = f"; it looks like {unit}" if unit else ""
    return f", which spans {first_ns} to {last_ns} ns{hint}"


def edge_between(loop: RelativePose, a: End, b: End) -> RelativePose:
    """Return the loop from vertex to vertex, with its covariance seen from there.

    Raises:
        MapError: If both ends lie at one vertex.
    """
    if (a.mission_id, a.vertex_ns) == (b.mission_id, b.vertex_ns):
        raise MapError("both ends lie at one vertex")
    measured = Motion(loop.T_a_b, loop.covariance)
    to_a, from_b = Motion.exact(a.T_vertex_stamp), Motion.exact(b.T_vertex_stamp.inverse())
    moved = to_a.then(measured).then(from_b)
    return replace(
        loop,
        mission_a=a.mission_id,
        stamp_a_ns=a.vertex_ns,
        mission_b=b.mission_id,
        stamp_b_ns=b.vertex_ns,
        T_a_b=moved.T,
        covariance=moved.covariance,
    )


def checked(loop: LoopClosure, min_quality: float) -> RelativePose:
    """Return what a message measured, between the robots and the instants that it names.

    Raises:
        MapError: If its quality is too low, or its covariance is none.
    """
    if not loop.quality >= min_quality:
        raise MapError(f"its quality is {loop.quality:g}, below {min_quality:g}")
    covariance = loop.covariance
    is_symmetric = np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12)
    if not (np.isfinite(covariance).all() and is_symmetric):
        raise MapError("its covariance is not symmetric and finite")
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise MapError("its covariance is not positive definite")
    return RelativePose(
        kind="loop",
        mission_a=loop.robot_a,
        stamp_a_ns=loop.stamp_a_ns,
        mission_b=loop.robot_b,
        stamp_b_ns=loop.stamp_b_ns,
        T_a_b=loop.T_a_b,
        covariance=covariance,
        source=loop.source,
        is_switchable=True,
    )
