"""World W-LID: a LiDAR and an IMU driven once round a ring of corridors, and a little further."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.corridor import Corridor
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.ring import MIN_LENGTH_M, Ring
from mapstream.recordings.worlds.sensors import (
    ImuConfig,
    Lidar,
    LidarConfig,
    drifting_odometry,
    imu_batches,
)
from mapstream.recordings.worlds.simulation import Record, Simulation
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert, se3_exp, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import WheelOdometry

START_NS = 1_700_000_000 * 10**9
# Turned, so that a forgotten extrinsic shows; level, or point-to-point ICP would climb along the rings.
T_BASE_LIDAR = SE3.from_rotation(so3_exp([0.0, 0.0, 0.4]), [0.2, 0.0, 1.1])
T_BASE_IMU = SE3.from_rotation(np.eye(3), [0.05, -0.03, 0.2])
_KNOT_NS = 50_000_000  # between the points of the motion's spline
_TRUTH_NS = 10_000_000
_STAND_S = 1.0
_RAMP_S = 2.5
_SPIN_PERIOD_S = 9.0
_CORNER_SPEED = 0.7  # of the speed on the straight


class WLidConfig(BaseModel):
    """Options of W-LID."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    length_m: float = Field(default=300.0, ge=MIN_LENGTH_M)
    """Length of the loop, once round."""
    overlap_fraction: NonNegativeFloat = 0.08
    """The part of the loop that is driven a second time."""
    start_fraction: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Where on the loop the drive begins."""
    reverse: bool = False
    """The loop is driven the other way round."""
    building: int | None = Field(default=None, ge=0)
    """The seed whose corridors these are, so that several drives share them; null: the drive's own."""
    speed_mps: PositiveFloat = 3.2
    """Speed on the straight; corners are slower."""
    odometry_drift: NonNegativeFloat = 0.005
    """Drift of the topic `/odometry`, as a part of the distance."""
    wheel_drift: NonNegativeFloat | None = None
    """With wheels, which roll every way without slipping: the drift of the topic `/wheels`; null: there are none."""
    aggressive: bool = False
    """Spins at 90 deg/s, to one side and the other."""
    blank_walls: bool = False
    """Corridors that say nothing of the motion along them."""
    lidar: LidarConfig = LidarConfig()
    imu: ImuConfig = ImuConfig()


def w_lid(config: WLidConfig, seed: int) -> Simulation:
    """Return the recording of one drive; equal arguments give equal recordings.

    Topics: `/points`, `/imu`, `/odometry` (drifts), `/wheels` if there are, and `/truth`, the pose of the base
    in the world, which is where the base starts unless `start_fraction` or `reverse` says otherwise.
    """
    seeds = np.random.SeedSequence(seed).spawn(5)
    if config.building is not None:
        seeds[0] = np.random.SeedSequence(config.building).spawn(1)[0]
    world_rng, lidar_rng, imu_rng, odometry_rng, wheel_rng = map(np.random.default_rng, seeds)
    ring = Ring(config.length_m)
    motion = drive(ring, config)
    caster = RayCaster(Corridor(ring, world_rng, is_blank=config.blank_walls).mesh())
    lidar = Lidar(config.lidar, T_BASE_LIDAR, lidar_rng)
    stamps_ns = np.arange(motion.start_ns, motion.end_ns + 1, _TRUTH_NS)
    poses = motion.poses(stamps_ns)
    coarse = slice(None, None, 5)
    truth = (_odometry(ns, T) for ns, T in zip(stamps_ns.tolist(), poses, strict=True))
    odometry = drifting_odometry(
        poses[coarse], stamps_ns[coarse], config.odometry_drift, odometry_rng
    )
    wheels = _wheels(poses[coarse], stamps_ns[coarse], config.wheel_drift, wheel_rng)
    imu = imu_batches(config.imu, T_BASE_IMU, motion, imu_rng)
    starts = range(motion.start_ns, motion.end_ns - lidar.period_ns + 1, lidar.period_ns)
    scans = (lidar.scan(caster, motion, start) for start in starts)
    return Simulation(
        start_ns=motion.start_ns,
        end_ns=motion.end_ns,
        records=merge(
            (Record(m.stamp_ns, "/imu", m) for m in imu),
            (Record(m.stamp_ns, "/odometry", m) for m in odometry),
            (Record(m.stamp_ns, "/wheels", m) for m in wheels),
            (Record(m.stamp_ns, "/truth", m) for m in truth),
            (Record(m.stamp_ns + lidar.period_ns, "/points", m) for m in scans),
            key=lambda record: record.log_ns,
        ),
    )


def _odometry(stamp_ns: int, T_world_base: FloatArray) -> Odometry:
    return Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T_world_base))


def _wheels(
    poses: FloatArray, stamps_ns: IntArray, drift: float | None, rng: np.random.Generator
) -> Iterator[WheelOdometry]:
    """Yield what wheels say of a path (N, 4, 4): that of its shadow on the floor, and nothing without wheels."""
    if drift is None:
        return
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    shadow = se3_exp(yaw[:, None] * [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    shadow[:, :2, 3] = poses[:, :2, 3]
    for each in drifting_odometry(invert(shadow[0]) @ shadow, stamps_ns, drift, rng):
        yield WheelOdometry(stamp_ns=each.stamp_ns, T_odom_base=each.T_odom_base)


def drive(ring: Ring, config: WLidConfig) -> Motion:
    """Return the motion: a second at rest, gently off, and round the ring with the overlap."""
    distance_m = ring.length_m * (1 + config.overlap_fraction)
    driven_m = _distances(ring, distance_m, config)
    s_m = _along(ring, driven_m, config)
    t_s = np.arange(len(s_m)) * _KNOT_NS / 1e9
    ramp = np.clip((t_s - _STAND_S) / _RAMP_S, 0, 1)
    moving = ramp * ramp * (3 - 2 * ramp)
    sway = np.sin(2 * np.pi * driven_m / 17.0)
    positions = ring.points(s_m, 0.12 * sway, 0.004 * moving * np.sin(2 * np.pi * 1.7 * t_s))
    rpy_rad = np.stack(
        [
            0.005 * moving * np.sin(2 * np.pi * 0.9 * t_s),
            0.004 * moving * np.sin(2 * np.pi * 1.3 * t_s),
            ring.headings(s_m) + np.pi * config.reverse + 0.12 * sway * moving,
        ],
        axis=1,
    )
    if config.aggressive:
        rpy_rad[:, 2] += _spins(t_s - _STAND_S - _RAMP_S)
    stamps_ns = START_NS + np.arange(len(s_m)) * _KNOT_NS
    return Motion(stamps_ns, positions, rpy_rad)


def _along(ring: Ring, driven_m: FloatArray, config: WLidConfig) -> FloatArray:
    """Return the places on the ring [m] after distances from the start."""
    return config.start_fraction * ring.length_m + (-driven_m if config.reverse else driven_m)


def _distances(ring: Ring, distance_m: float, config: WLidConfig) -> FloatArray:
    """Return the distance driven at each knot [m]: from rest, slower in corners."""
    s, distances, t = 0.0, [], 0.0
    step_s = _KNOT_NS / 1e9
    ahead = np.linspace(-1.5, 1.5, 7)
    while s < distance_m:
        distances.append(s)
        near = _along(ring, s + ahead, config)
        bend = float(np.mean(ring.curvature(near))) * ring.radius_m
        speed = config.speed_mps * (1 - (1 - _CORNER_SPEED) * bend)
        start = np.clip((t - _STAND_S) / _RAMP_S, 0, 1)
        s += step_s * speed * start * start * (3 - 2 * start)
        t += step_s
    return np.array(distances)


def _spins(t_s: FloatArray) -> FloatArray:
    """Return headings [rad] of turns at 90 deg/s that change sides, from rest at t = 0."""
    rate = np.where(t_s > 0, np.pi / 2 * np.tanh(6 * np.sin(2 * np.pi * t_s / _SPIN_PERIOD_S)), 0.0)
    return np.cumsum(rate) * _KNOT_NS / 1e9
