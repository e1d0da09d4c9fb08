"""World W-RGBD: a colour and depth camera in the hand, in a room with a table and six things on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from itertools import chain

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.people import People
from mapstream.recordings.worlds.photographs import in_order
from mapstream.recordings.worlds.renderer import Renderer
from mapstream.recordings.worlds.rgbd_camera import COLOR, DEPTH, RgbdCamera, RgbdCameraConfig
from mapstream.recordings.worlds.rgbd_room import Room, rgbd_room
from mapstream.recordings.worlds.sensors import (
    ImuConfig,
    drifting_odometry,
    imu_series,
)
from mapstream.recordings.worlds.simulated_detector import (
    SimulatedDetector,
    SimulatedDetectorConfig,
)
from mapstream.recordings.worlds.simulation import Record, Simulation
from mapstream.recordings.worlds.truth import sensor_id, stamps_at, true_odometry, true_places
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import TransformBatch
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, Sensor

START_NS = 1_700_000_000 * 10**9
BASE = "base"
T_BASE_IMU = SE3.from_rotation(so3_exp([0.01, -0.02, 0.3]), [0.02, 0.01, -0.02])
# The camera's z is the base's x, a little turned.
T_BASE_CAMERA = SE3.from_rotation(
    np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ so3_exp([0.01, -0.008, 0.005]),
    [0.04, 0.02, 0.03],
)


class WRgbdConfig(BaseModel):
    """Options of W-RGBD."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    duration_s: PositiveFloat = Field(default=40.0, ge=4.0)
    """The way is the same, however long it takes."""
    camera: RgbdCameraConfig = RgbdCameraConfig()
    imu: ImuConfig = ImuConfig()
    room_seed: int | None = None
    """Of the room, if several recordings are made in one; else the recording's."""
    texel_m: PositiveFloat = 0.003
    """Of the pictures on all surfaces; a coarse one is made sooner."""
    odometry_drift: NonNegativeFloat = 0.01
    """Of the topic `/odometry`, as a part of the distance."""
    people: int = Field(default=0, ge=0, le=5)
    """So many walk about beyond the table."""
    without: tuple[str, ...] = ()
    """Things and furniture that are not there: cupboard, crate, or a class of things."""
    objects: SimulatedDetectorConfig | None = None
    """A detector of the things on the table and of people, as good as said; none without."""


@dataclass(frozen=True, slots=True, eq=False)
class RgbdWorld:
    """The room of a recording, and a camera that answers what is seen from any pose."""

    room: Room
    people: People
    camera: RgbdCamera


def rgbd_world(config: WRgbdConfig, seed: int) -> RgbdWorld:
    """Return the truth behind a recording: surfaces, things, and ideal depth from any pose."""
    room = rgbd_room(seed if config.room_seed is None else config.room_seed, texel_m=config.texel_m)
    room = room.without(config.without)
    people = People(config.people, seed, START_NS, texel_m=config.texel_m)
    renderer = Renderer(room.surfaces)
    camera = RgbdCamera(config.camera, renderer, T_BASE_CAMERA, seed, people)
    return RgbdWorld(room, people, camera)


def w_rgbd(config: WRgbdConfig, seed: int) -> Simulation:
    """Return the recording of one way round the room; equal arguments give equal recordings.

    Topics: `/color/image`, `/depth/image` (16UC1 [mm], of the same pixels), `/points` if asked for, `/imu`,
    `/odometry` (drifts); `/truth`, the pose of the base in the room; `/truth/things`, where what is. With a detector
    `/color/objects` as well, and `/truth/objects`, row by row what was detected, and then what was missed.
    """
    imu_rng, odometry_rng = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2))
    span_ns = (START_NS, START_NS + round(config.duration_s * 1e9))
    world, motion = rgbd_world(config, seed), orbit(config.duration_s, START_NS)
    imu = imu_series(config.imu, T_BASE_IMU, motion, span_ns, imu_rng)
    odometry_ns = stamps_at(20.0, span_ns)
    odometry = drifting_odometry(
        motion.poses(odometry_ns), odometry_ns, config.odometry_drift, odometry_rng
    )
    stamps_ns = stamps_at(config.camera.rate_hz, span_ns)
    poses = motion.poses(stamps_ns) @ T_BASE_CAMERA.matrix
    shots = zip(range(len(poses)), stamps_ns.tolist(), poses, strict=True)
    detector = _detector(config, world, seed)
    taken = in_order(lambda shot: list(_records(*shot, world, detector, config)), shots)
    return Simulation(
        start_ns=span_ns[0],
        end_ns=span_ns[1],
        rig=_rig(config),
        records=merge(
            [Record(START_NS, "/truth/things", _true_things(world.room))],
            (Record(m.stamp_ns, "/imu", m) for m in imu.batches()),
            (Record(m.stamp_ns, "/odometry", m) for m in odometry),
            (Record(m.stamp_ns, "/truth", m) for m in true_odometry(motion, imu, span_ns)),
            chain.from_iterable(taken),
            key=lambda record: record.log_ns,
        ),
    )


def _detector(config: WRgbdConfig, world: RgbdWorld, seed: int) -> SimulatedDetector | None:
    if config.objects is None:
        return None
    things = [*world.room.things, *world.people.things(START_NS, np.eye(4))]
    return SimulatedDetector(
        config.objects, world.room.surfaces, things, COLOR, T_BASE_CAMERA, seed
    )


def _records(
    number: int,
    stamp_ns: int,
    T_world_camera: FloatArray,
    world: RgbdWorld,
    detector: SimulatedDetector | None,
    config: WRgbdConfig,
) -> Iterator[Record]:
    """Yield what the camera, and whoever looks at its images, says of one moment."""
    view = world.camera.ideal_at(stamp_ns, T_world_camera)
    color, depth = world.camera.images(view, number, stamp_ns)
    yield Record(stamp_ns, "/color/image", color)
    yield Record(stamp_ns, "/depth/image", depth)
    if config.camera.clouds:
        yield Record(stamp_ns, "/points", world.camera.cloud(color, depth))
    if detector is not None:
        things = [*world.room.things, *world.people.things(stamp_ns, T_world_camera)]
        detected = detector.detect(view.surfaces, things, T_world_camera, number, stamp_ns)
        yield Record(stamp_ns, "/color/objects", detected.detections)
        yield Record(stamp_ns, "/truth/objects", detected.truth)


def _true_things(room: Room) -> TransformBatch:
    return true_places({thing.name: thing.T_world_thing for thing in room.things}, START_NS)


def _rig(config: WRgbdConfig) -> Rig:
    """Return what the recording says of its sensors. The odometry's sensor is the base."""
    odometry = Sensor(id=sensor_id(BASE), kind="odometry", topic="/odometry", frame=BASE)
    inertial = config.imu.sensor(sensor_id("imu"))
    color, depth = (
        CameraSensor(
            id=sensor_id(name),
            topic=f"/{name}/image",
            frame=name,
            calibration=config.camera.calibration(name),
        )
        for name in (COLOR, DEPTH)
    )
    sensors = (odometry, inertial, color, depth)
    hangs = (SE3.identity(), T_BASE_IMU, T_BASE_CAMERA, T_BASE_CAMERA)
    extrinsics = [
        Extrinsics(sensor_id=sensor.id, base_sensor_id=odometry.id, T_base_sensor=place)
        for sensor, place in zip(sensors, hangs, strict=True)
    ]
    return Rig(sensors, extrinsics, base_frame=BASE)
