"""What any sensor may say about a pose: where it is in the world, or where a landmark is from it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapstream.streams.arrays import FloatArray, frozen, frozen_optional
from mapstream.streams.geometry import SE3


def _unmeasured() -> FloatArray:
    return np.diag(np.full(6, np.inf))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OuterFrame:
    """A reference frame of absolute measurements: a geodetic plane, a motion capture room."""

    name: str  # enu, utm, vicon ...; one name is one frame in a map
    crs: str = (
        ""  # enu (a plane that touches the ellipsoid at the origin), or a projection: EPSG:32632
    )
    origin_lla: FloatArray | None = None  # (3,) WGS84 latitude [deg], longitude [deg], height [m]
    T_map_frame: SE3 | None = None  # where it is known to lie; otherwise it is estimated

    def __post_init__(self) -> None:
        frozen_optional(self, "origin_lla", np.float64, (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkRef:
    """A landmark that a measurement recognised."""

    name: str  # its identity: measurements with one name are of one landmark
    kind: str = "point"  # point (3D), point2d, pose, plane, beacon ...
    label: str = ""  # semantic class


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Constraint:
    """A measurement on the pose at one stamp: of the world around (`outer`), or of a landmark.

    It becomes one edge of the map, of this kind; kinds register in `operators/estimation`.
    """

    stamp_ns: int
    kind: str  # absolute, position, gravity, landmark, plane, range ...
    T_a_b: SE3 = field(default_factory=SE3.identity)  # T_outer_sensor, or T_base_landmark
    covariance: FloatArray = field(default_factory=_unmeasured)  # (6, 6); infinite: not measured
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    outer: OuterFrame | None = None  # None: the map frame
    landmark: LandmarkRef | None = None
    payload: bytes = b""  # JSON: what the kind needs beyond this
    is_switchable: bool = False  # an optimizer may find that it is false
    source: str = ""  # the operator or sensor that measured it

    def __post_init__(self) -> None:
        frozen(self, "covariance", np.float64, (6, 6))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopClosure:
    """Where one robot was at one time, seen from where it or another was at another time."""

    robot_a: str  # the id of a mission, its first digits, or a name that the receiver knows
    stamp_a_ns: int
    robot_b: str
    stamp_b_ns: int
    T_a_b: SE3  # from the base of b at its time to the base of a at its time
    covariance: FloatArray  # (6, 6) rotation first [rad, m]
    quality: float = 1.0  # as its finder rates it, more is better
    source: str = ""  # who found it

    def __post_init__(self) -> None:
        frozen(self, "covariance", np.float64, (6, 6))

    @property
    def stamp_ns(self) -> int:
        return max(self.stamp_a_ns, self.stamp_b_ns)
