"""A small room full of boxes and drives through it: scans with truth, in a blink and without files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.worlds.mesh import Mesh, box, join
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.sensors import Lidar, LidarConfig
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.trajectory import Trajectory

_START_NS = 1_700_000_000 * 10**9
_KNOT_NS = 50_000_000
_SMALL_LIDAR = LidarConfig(beams=24, columns=240, range_noise_m=0.005, dropout=0.0)


@dataclass(frozen=True, slots=True)
class Drive:
    """What a LiDAR saw on a drive, and where it was."""

    scans: Sequence[LidarScan]
    truth: Trajectory  # T_world_base, from rest at the origin


def box_room(seed: int = 0, *, size_m: float = 12.0, num_boxes: int = 40) -> Mesh:
    """Return a room around the origin, 4 m high, with boxes on its floor and walls."""
    rng = np.random.default_rng(seed)
    half = size_m / 2
    boxes = [box(SE3.from_rotation(np.eye(3), [0, 0, 1.5]), [size_m, size_m, 4.0], 0.5)]
    for _ in range(num_boxes):
        angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.6, 3)
        reach = rng.uniform(0.55, 0.95) * half
        t = [reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-0.5, 2.5)]
        T_world_box = SE3.from_rotation(so3_exp(rng.uniform(-0.5, 0.5, 3)), t)
        boxes.append(box(T_world_box, size, rng.uniform(0.1, 0.9)))
    return join(boxes)


def drive_through(
    mesh: Mesh,
    *,
    num_scans: int = 10,
    speed_mps: float = 1.0,
    turn_radps: float = 0.0,
    lidar: LidarConfig = _SMALL_LIDAR,
    seed: int = 0,
) -> Drive:
    """Drive from the origin along x, or on a circle, at constant speed; the LiDAR is the base."""
    sensor = Lidar(lidar, SE3.identity(), np.random.default_rng(seed))
    t_s = np.arange(-2, num_scans * sensor.period_ns // _KNOT_NS + 3) * _KNOT_NS / 1e9
    heading = turn_radps * t_s
    chord = speed_mps * t_s * np.sinc(heading / 2 / np.pi)
    zero = np.zeros_like(t_s)
    motion = Motion(
        _START_NS + np.rint(t_s * 1e9).astype(np.int64),
        np.stack([chord * np.cos(heading / 2), chord * np.sin(heading / 2), zero], axis=1),
        np.stack([zero, zero, heading], axis=1),
    )
    caster = RayCaster(mesh)
    starts = _START_NS + np.arange(num_scans) * sensor.period_ns
    stamps_ns = np.arange(_START_NS, _START_NS + (num_scans + 1) * sensor.period_ns, 10_000_000)
    return Drive(
        scans=tuple(sensor.scan(caster, motion, int(start)) for start in starts),
        truth=Trajectory(stamps_ns=stamps_ns, poses=motion.poses(stamps_ns)),
    )
