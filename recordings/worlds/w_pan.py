"""World W-PAN: a room seen by a depth camera that pans and tilts on a robot that drives a bend.

Where the camera sits is told by `/tf` alone, as of a real robot: clouds carry their frame and no place.
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.box_room import box_room
from mapstream.recordings.worlds.depth_camera import DepthCamera, DepthCameraConfig
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.simulation import Record, Simulation
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan, TransformBatch

START_NS = 1_700_000_000 * 10**9
BASE, MAST, HEAD, CAMERA = "base_link", "mast", "head", "depth"
T_BASE_MAST = SE3.from_rotation(np.eye(3), [0.2, 0.0, 1.2])
# The camera's z is the head's x, and it sits beside the axes, so that turning also moves it.
T_HEAD_CAMERA = SE3.from_rotation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.05, 0.03, 0.08]
)
_KNOT_NS = 50_000_000
_TRUTH_NS = 10_000_000
_TF_NS = 20_000_000


class WPanConfig(BaseModel):
    """Options of W-PAN."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    duration_s: PositiveFloat = 8.0
    speed_mps: NonNegativeFloat = 0.25
    turn_radps: float = 0.1
    pan_rad: NonNegativeFloat = 1.0
    """To either side."""
    pan_period_s: PositiveFloat = 5.0
    tilt_rad: NonNegativeFloat = 0.3
    """Up and down."""
    tilt_period_s: PositiveFloat = 3.0
    camera: DepthCameraConfig = DepthCameraConfig()


def w_pan(config: WPanConfig, seed: int) -> Simulation:
    """Return the recording of one drive; equal arguments give equal recordings.

    Topics: `/points`, clouds in the frame of the camera; `/tf` and `/tf_static`; `/truth`, the pose of
    the base in the world.
    """
    caster = RayCaster(box_room(seed))
    camera = DepthCamera(config.camera, CAMERA, np.random.default_rng(seed))
    end_ns = START_NS + round(config.duration_s * 1e9)
    motion, head = _drive(config, end_ns), _head(config, end_ns)
    clouds = _clouds(camera, caster, motion, head, end_ns)
    return Simulation(
        start_ns=START_NS,
        end_ns=end_ns,
        records=merge(
            [Record(START_NS, "/tf_static", _mountings())],
            (Record(m.stamp_ns, "/tf", m) for m in _turns(head, end_ns)),
            (Record(m.stamp_ns, "/truth", m) for m in _truth(motion, end_ns)),
            (Record(m.stamp_ns, "/points", m) for m in clouds),
            key=lambda record: record.log_ns,
        ),
    )


def _knots(end_ns: int) -> tuple[IntArray, FloatArray]:
    """Return stamps (N,) that reach beyond both ends, and the seconds since the start."""
    stamps_ns = np.arange(START_NS - 2 * _KNOT_NS, end_ns + 3 * _KNOT_NS, _KNOT_NS)
    return stamps_ns, (stamps_ns - START_NS) / 1e9


def _drive(config: WPanConfig, end_ns: int) -> Motion:
    """Return T_world_base: a bend through the middle of the room, at constant speed."""
    stamps_ns, t_s = _knots(end_ns)
    heading = config.turn_radps * (t_s - config.duration_s / 2)
    way = config.speed_mps * (t_s - config.duration_s / 2) * np.sinc(heading / 2 / np.pi)
    zero = np.zeros_like(t_s)
    positions = np.stack([way * np.cos(heading / 2), way * np.sin(heading / 2), zero], axis=1)
    return Motion(stamps_ns, positions, np.stack([zero, zero, heading], axis=1))


def _head(config: WPanConfig, end_ns: int) -> Motion:
    """Return T_mast_head: a pan about z and a tilt about y, back and forth."""
    stamps_ns, t_s = _knots(end_ns)
    pan = config.pan_rad * np.sin(2 * np.pi * t_s / config.pan_period_s)
    tilt = config.tilt_rad * np.sin(2 * np.pi * t_s / config.tilt_period_s)
    return Motion(
        stamps_ns, np.zeros((len(t_s), 3)), np.stack([np.zeros_like(t_s), tilt, pan], axis=1)
    )


def _clouds(
    camera: DepthCamera, caster: RayCaster, motion: Motion, head: Motion, end_ns: int
) -> Iterator[LidarScan]:
    stamps_ns = np.arange(START_NS, end_ns + 1, round(1e9 / camera.config.rate_hz))
    T_base_head = T_BASE_MAST.matrix @ head.poses(stamps_ns)
    T_world_camera = motion.poses(stamps_ns) @ T_base_head @ T_HEAD_CAMERA.matrix
    for stamp_ns, T in zip(stamps_ns.tolist(), T_world_camera, strict=True):
        yield camera.cloud(caster, T, stamp_ns)


def _turns(head: Motion, end_ns: int) -> Iterator[TransformBatch]:
    stamps_ns = np.arange(START_NS, end_ns + _TF_NS, _TF_NS)  # no cloud comes after the last one
    for stamp_ns, T in zip(stamps_ns, head.poses(stamps_ns), strict=True):
        yield TransformBatch(
            stamps_ns=np.array([stamp_ns]),
            parents=(MAST,),
            children=(HEAD,),
            T_parent_child=T[None],
        )


def _mountings() -> TransformBatch:
    return TransformBatch(
        stamps_ns=np.full(2, START_NS),
        parents=(BASE, HEAD),
        children=(MAST, CAMERA),
        T_parent_child=np.stack([T_BASE_MAST.matrix, T_HEAD_CAMERA.matrix]),
        is_static=True,
    )


def _truth(motion: Motion, end_ns: int) -> Iterator[Odometry]:
    stamps_ns = np.arange(START_NS, end_ns + _TRUTH_NS, _TRUTH_NS)
    for stamp_ns, T in zip(stamps_ns.tolist(), motion.poses(stamps_ns), strict=True):
        yield Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T))
