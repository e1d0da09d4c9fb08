"""World W-2D: a holonomic robot with a planar laser, twice round the corridors of an office."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.depth_camera import DepthCamera, DepthCameraConfig
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.office import DEPTH_M, MIN_WIDTH_M, Office, office
from mapstream.recordings.worlds.office_drive import Route, office_drive
from mapstream.recordings.worlds.planar_laser import PlanarLaser, PlanarLaserConfig
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.simulation import Record, Simulation
from mapstream.recordings.worlds.slipping_wheels import wheel_odometry
from mapstream.recordings.worlds.truth import stamps_at
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapstream.streams.messages.sensors import CameraFrame

START_NS = 1_700_000_000 * 10**9
# Turned and beside the middle, so that a forgotten extrinsic shows.
T_BASE_LASER = SE3.from_rotation(so3_exp([0.0, 0.0, 0.15]), [0.18, 0.04, 0.25])
DEPTH = "depth"
# The camera's z is the base's x, a little downwards.
T_BASE_DEPTH = SE3.from_rotation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3_exp([-0.2, 0.0, 0.0]), [0.15, -0.06, 0.9]
)
_TRUTH_HZ = 50.0
_PLAN_M = 0.05  # side of the plan's cells
_MARGIN_M = 0.5  # of the plan, beyond the inner side of the outer walls


class W2dConfig(BaseModel):
    """Options of W-2D."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    width_m: float = Field(default=26.0, ge=MIN_WIDTH_M)
    """Length of the floor; a lap round its corridors is twice that and 8 m."""
    laps: PositiveFloat = 2.0
    visits: bool = True
    """In the first lap the robot drives into every room."""
    is_reverse: bool = False
    """The way from its end to its start."""
    speed_mps: PositiveFloat = 0.8
    slip: NonNegativeFloat = 0.02
    """By about how much wheels count wrong, as a part of the way; aside it is twice that."""
    wheels_hz: PositiveFloat = 50.0
    laser: PlanarLaserConfig = PlanarLaserConfig()
    depth: DepthCameraConfig | None = None
    """A depth camera that looks ahead, from the height of a table; none without."""
    furnished: bool = True
    blank_walls: bool = False
    """Corridors without doors, rooms and furniture, that say nothing of the motion along them."""
    building_seed: int | None = None
    """Of the building, if several recordings are made in one; else the recording's."""


def w_2d(config: W2dConfig, seed: int) -> Simulation:
    """Return the recording of one drive; equal arguments give equal recordings.

    Topics: `/scan`; `/odom`, of wheels that slip; `/depth/image`, if asked for; `/truth`, the pose of the base in the building,
    whose origin is where a drive starts that is not reversed; `/truth/plan`, the building.
    """
    drive_rng, laser_rng, wheels_rng, depth_rng = map(
        np.random.default_rng, np.random.SeedSequence(seed).spawn(4)
    )
    floor = w_2d_floor(config, seed)
    route = Route(
        laps=config.laps,
        visits=config.visits,
        is_reverse=config.is_reverse,
        speed_mps=config.speed_mps,
    )
    motion = office_drive(floor, route, START_NS, drive_rng)
    caster, laser = RayCaster(floor.mesh()), PlanarLaser(config.laser, T_BASE_LASER, laser_rng)
    span_ns = (START_NS, motion.end_ns)
    stamps_ns = stamps_at(config.wheels_hz, span_ns)
    wheels = wheel_odometry(motion.poses(stamps_ns), stamps_ns, config.slip, wheels_rng)
    starts = range(START_NS, motion.end_ns - laser.sweep_ns + 1, laser.period_ns)
    scans = (laser.scan(caster, motion, start) for start in starts)
    frames = () if config.depth is None else _frames(config.depth, motion, floor, depth_rng)
    return Simulation(
        start_ns=START_NS,
        end_ns=motion.end_ns,
        records=merge(
            [Record(START_NS, "/truth/plan", plan_of(floor))],
            (Record(m.stamp_ns, "/odom", m) for m in wheels),
            (Record(m.stamp_ns, "/truth", m) for m in _truth(motion)),
            (Record(m.stamp_ns, "/depth/image", m) for m in frames),
            (Record(m.stamp_ns + laser.sweep_ns, "/scan", m) for m in scans),
            key=lambda record: record.log_ns,
        ),
    )


def w_2d_floor(config: W2dConfig, seed: int) -> Office:
    """Return the building of a recording."""
    building_seed = seed if config.building_seed is None else config.building_seed
    return office(
        config.width_m,
        np.random.default_rng([building_seed, 2]),
        has_rooms=not config.blank_walls,
        furnished=config.furnished and not config.blank_walls,
    )


def plan_of(floor: Office) -> OccupancyGrid:
    """Return the building as a grid in its own frame: solid, free within the outer walls, else unknown."""
    columns, rows = (
        int(np.ceil((size + 2 * _MARGIN_M) / _PLAN_M)) for size in (floor.width_m, DEPTH_M)
    )
    corner = floor.corner - _MARGIN_M
    x, y = (np.arange(count) + 0.5 for count in (columns, rows))
    points = np.stack(np.meshgrid(x, y), axis=-1) * _PLAN_M + corner
    cells = np.where(floor.is_inside(points), FREE, UNKNOWN)
    cells[floor.is_solid(points)] = OCCUPIED
    T_world_grid = SE3.from_rotation(np.eye(3), [*corner, 0.0])
    return OccupancyGrid(
        stamp_ns=START_NS, cells=cells, resolution_m=_PLAN_M, T_map_grid=T_world_grid
    )


def _frames(
    config: DepthCameraConfig, motion: Motion, floor: Office, rng: np.random.Generator
) -> Iterator[CameraFrame]:
    camera, caster = DepthCamera(config, DEPTH, rng), RayCaster(floor.mesh())
    stamps_ns = stamps_at(config.rate_hz, (START_NS, motion.end_ns))
    poses = motion.poses(stamps_ns) @ T_BASE_DEPTH.matrix
    for stamp_ns, T in zip(stamps_ns.tolist(), poses, strict=True):
        yield camera.image(caster, T, stamp_ns, T_BASE_DEPTH)


def _truth(motion: Motion) -> list[Odometry]:
    stamps_ns = stamps_at(_TRUTH_HZ, (START_NS, motion.end_ns))
    poses = motion.poses(stamps_ns)
    return [
        Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T))
        for stamp_ns, T in zip(stamps_ns.tolist(), poses, strict=True)
    ]
