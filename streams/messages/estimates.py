"""What operators conclude: odometry, keyframes, submaps, loop closures, corrections.

Covariances are (6, 6) of the tangent vector, rotation first [rad, m], perturbation on the right.
What was not measured has an infinite variance where it is an axis, and `UNOBSERVED_VARIANCE` along any
direction; both leave it out of what is estimated.
A mission is named by 32 hex digits; with a stamp they name one vertex.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray, frozen, frozen_optional
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.sensors import ImuBatch, RecordRef
from mapstream.streams.messages.vision import ImageFeatures

UNOBSERVED_VARIANCE = 1e6  # [rad^2, m^2]; much more would cost the digits of the other directions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Odometry:
    """Pose of the base in a frame that drifts but does not jump."""

    stamp_ns: int
    T_odom_base: SE3
    covariance: FloatArray | None = None  # (6, 6) of the step since the previous message
    velocity_mps: FloatArray | None = None  # (3,) of the base, in the odom frame
    gyro_bias_radps: FloatArray | None = None  # (3,)
    accel_bias_mps2: FloatArray | None = None  # (3,)
    is_lost: bool = False  # the step to this pose was predicted, not measured

    def __post_init__(self) -> None:
        frozen_optional(self, "covariance", np.float64, (6, 6))
        for name in ("velocity_mps", "gyro_bias_radps", "accel_bias_mps2"):
            frozen_optional(self, name, np.float64, (3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """Points that belong together, free of motion distortion, in the base frame at stamp_ns."""

    stamp_ns: int
    points: Float32Array  # (N, 3) [m]
    intensity: Float32Array | None = None  # (N,)
    colors_rgba: npt.NDArray[np.uint8] | None = None  # (N, 4); alpha 0 where no camera saw it
    record: RecordRef | None = None  # the raw measurement it was made from

    def __post_init__(self) -> None:
        n = frozen(self, "points", np.float32, (None, 3)).shape[0]
        frozen_optional(self, "intensity", np.float32, (n,))
        frozen_optional(self, "colors_rgba", np.uint8, (n, 4))

    @property
    def colors_rgb(self) -> npt.NDArray[np.uint8] | None:
        """The colours (N, 3), black where no camera looked; None if none looked anywhere."""
        return None if self.colors_rgba is None else self.colors_rgba[:, :3]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """A measured transform between two vertices: odometry, registration or loop closure."""

    kind: Literal["odometry", "wheel", "registration", "loop", "motion_model", "imu"]
    mission_a: str
    stamp_a_ns: int
    mission_b: str
    stamp_b_ns: int
    T_a_b: SE3
    covariance: FloatArray  # (6, 6)
    source: str = ""  # the operator that measured it
    is_switchable: bool = False  # an optimizer may find that it is false

    def __post_init__(self) -> None:
        frozen(self, "covariance", np.float64, (6, 6))

    @property
    def stamp_ns(self) -> int:
        return max(self.stamp_a_ns, self.stamp_b_ns)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splice:
    """A pose inside a stretch that went out already, for measurements that came late.

    Each of its edges with the source of an edge over the whole interval takes part of that one's place:
    the optimizer removes the old edge (OmniMapper, section III-C, "pose splicing").
    """

    keyframe: Keyframe
    edges: tuple[RelativePose, ...]
    constraints: tuple[Constraint, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A moment worth a vertex, with what was seen at it.

    The covariance of its odometry is that of the step since the keyframe before; the first has none.
    """

    stamp_ns: int
    odometry: Odometry
    cloud: PointCloud | None = None
    records: tuple[RecordRef, ...] = ()  # the raw measurements, where they lie
    features: tuple[ImageFeatures, ...] = ()  # of all cameras, of all kinds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Submap:
    """A stretch of one mission: consecutive keyframes and the edges between them.

    The first keyframe repeats the last one of the submap before (maplab 2.0, section III-C), so that
    no edge is cut.
    """

    mission_id: str  # 32 hex digits
    index: int  # 0, 1, 2 ... within the mission
    keyframes: tuple[Keyframe, ...]
    edges: tuple[RelativePose, ...]
    constraints: tuple[Constraint, ...] = ()  # each at the stamp of a keyframe of the mission
    imu: ImuBatch | None = None  # samples from the first to the last keyframe, and one beyond each
    splices: tuple[Splice, ...] = ()  # into earlier submaps of the mission; they come first
    sensors: str = "{}"  # JSON: the sensor set with its calibration; that of submap 0 counts

    def __post_init__(self) -> None:
        if not self.keyframes:
            raise ValueError(f"Submap {self.index} of {self.mission_id}: no keyframes")

    @property
    def stamp_ns(self) -> int:
        return self.keyframes[-1].stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopReport:
    """What a search for loop closures tried and what came of it; `edges` holds the accepted ones."""

    stamp_ns: int
    edges: tuple[RelativePose, ...] = ()
    candidates: tuple[LoopCandidate, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopCandidate:
    """One pair of places that was compared, and why it was accepted or rejected."""

    stamp_a_ns: int
    stamp_b_ns: int
    distance_m: float  # between the two, by the poses of that time
    verdict: str  # "accepted", or the reason for the refusal
    inlier_fraction: float = float("nan")
    rmse_m: float = float("nan")
    num_matches: int = 0  # of features
    num_inliers: int = 0
    score: float = float("nan")  # by which it was chosen among other places


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapCorrection:
    """The optimised poses of one mission: what robots and loop search take for the truth so far."""

    stamp_ns: int  # of the newest vertex
    mission_id: str
    stamps_ns: IntArray  # (N,) increasing
    T_mission_base: FloatArray  # (N, 4, 4)
    T_mission_odom: SE3  # carries odometry newer than stamp_ns into the mission frame
    T_map_mission: SE3 | None = None  # None while the mission is not anchored

    def __post_init__(self) -> None:
        n = frozen(self, "stamps_ns", np.int64, (None,)).shape[0]
        frozen(self, "T_mission_base", np.float64, (n, 4, 4))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapPose:
    """Where the robot is in a map that is finished, by its odometry and by what it recognises of the map."""

    stamp_ns: int
    state: Literal[
        "lost", "tracking", "recovered"
    ]  # recovered: this pose ends a time of being lost
    T_map_base: SE3 | None = None  # None while lost
    T_map_odom: SE3 | None = None  # carries the odometry into the map
    covariance: FloatArray | None = None  # (6, 6) of T_map_base
    num_inliers: int = 0  # of the frame that was compared with the map since the pose before
    verdict: str = ""  # on that frame: accepted, or why not

    def __post_init__(self) -> None:
        frozen_optional(self, "covariance", np.float64, (6, 6))
