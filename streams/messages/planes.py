"""Flat surfaces that one sensor saw at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray, frozen, read_only
from mapstream.streams.geometry import SE3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneSegments:
    """Pieces of planes in the base frame: of a depth image, of a cloud, or the walls on a planar laser's lines.

    A segment is a pose on its plane: z is the normal towards the sensor, the origin lies amid its points.
    Of the covariance the rotations about x and y and the translation along z count; a direction that was
    not measured is infinite. A wall that a planar laser sees as a line has its x axis along the line, and
    no rotation about it.
    Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
    """

    stamp_ns: int
    T_base_plane: FloatArray  # (N, 4, 4)
    covariances: FloatArray  # (N, 6, 6) rotation first [rad, m], in the axes of the plane
    hulls_m: tuple[
        FloatArray, ...
    ]  # N of (K, 2): convex, counterclockwise, in x and y of the plane
    num_points: IntArray  # (N,)
    rmse_m: FloatArray  # (N,) of the points off their plane
    frame: str = "camera"  # the sensor
    T_base_sensor: SE3 = field(default_factory=SE3.identity)

    def __post_init__(self) -> None:
        n = frozen(self, "T_base_plane", np.float64, (None, 4, 4)).shape[0]
        frozen(self, "covariances", np.float64, (n, 6, 6))
        frozen(self, "num_points", np.int64, (n,))
        frozen(self, "rmse_m", np.float64, (n,))
        if len(self.hulls_m) != n:
            raise ValueError(f"PlaneSegments: {n} planes with {len(self.hulls_m)} hulls")
        object.__setattr__(self, "hulls_m", tuple(read_only(hull) for hull in self.hulls_m))

    def __len__(self) -> int:
        return len(self.num_points)
