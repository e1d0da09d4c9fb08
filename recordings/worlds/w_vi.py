"""World W-VI: a robot with cameras and an IMU flies figures of eight in a hall."""

from __future__ import annotations

from heapq import merge

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from mapstream.recordings.worlds.figure_eight import FlightConfig, eight, flight
from mapstream.recordings.worlds.hall import Hall, Tag, hall
from mapstream.recordings.worlds.renderer import Renderer
from mapstream.recordings.worlds.satellites import SatelliteConfig, satellite_fixes
from mapstream.recordings.worlds.sensors import (
    ImuConfig,
    drifting_odometry,
    imu_series,
)
from mapstream.recordings.worlds.simulation import Record, Simulation
from mapstream.recordings.worlds.studio import Studio
from mapstream.recordings.worlds.truth import stamps_at, true_odometry, true_places
from mapstream.recordings.worlds.vi_rig import (
    T_BASE_CAMERA,
    T_BASE_IMU,
    CameraName,
    ViCameraConfig,
    claimed_places,
    vi_rig,
)

START_NS = 1_700_000_000 * 10**9


class WViConfig(BaseModel):
    """Options of W-VI."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    cameras: tuple[CameraName, ...] = Field(default=tuple(T_BASE_CAMERA), min_length=1)
    camera: ViCameraConfig = ViCameraConfig()
    flight: FlightConfig = FlightConfig()
    imu: ImuConfig = ImuConfig()
    satellites: SatelliteConfig = SatelliteConfig()
    hall_seed: int | None = None
    """Of the hall, if several robots fly in one; else the recording's."""
    texel_m: PositiveFloat = 0.004
    """Of the pictures on all surfaces; a coarse one is made sooner."""
    tags: NonNegativeInt = Field(default=0, le=587)
    """AprilTags (36h11) on the walls."""
    tag_size_m: PositiveFloat = 0.5
    odometry_drift: NonNegativeFloat = 0.01
    """Of the topic `/odometry`, as a part of the distance."""
    odometry_turn_radpm: float = float(np.deg2rad(0.05))
    """Turned wrong by each metre."""


def w_vi(config: WViConfig, seed: int) -> Simulation:
    """Return the recording of one flight; equal arguments give equal recordings.

    Topics: `/NAME/image` of each camera, `/imu`, `/odometry` (drifts), `/gnss` if asked for; `/truth`, the pose of
    the base in the hall, with its velocity and the biases of the IMU; `/truth/tags`.
    """
    seeds = np.random.SeedSequence(seed).spawn(4)
    imu_rng, odometry_rng, satellite_rng, rig_rng = map(np.random.default_rng, seeds)
    span_ns = (START_NS, START_NS + round(config.flight.duration_s * 1e9))
    motion, place = flight(config.flight, START_NS), vi_hall(config, seed)
    imu = imu_series(config.imu, T_BASE_IMU, motion, span_ns, imu_rng)
    claims = claimed_places(config.camera, config.cameras, rig_rng)
    odometry_ns = stamps_at(20.0, span_ns)
    odometry = drifting_odometry(
        motion.poses(odometry_ns),
        odometry_ns,
        config.odometry_drift,
        odometry_rng,
        turn_radpm=config.odometry_turn_radpm,
    )
    fixes_ns = stamps_at(config.satellites.rate_hz, span_ns)
    fixes = satellite_fixes(config.satellites, motion, fixes_ns, satellite_rng)
    studio = Studio(config.camera, claims, Renderer(place.surfaces), motion, seed)
    readout_ns = round(config.camera.readout_s * 1e9)
    return Simulation(
        start_ns=span_ns[0],
        end_ns=span_ns[1],
        rig=vi_rig(config.camera, claims, config.imu),
        records=merge(
            _tag_records(place.tags),
            (Record(m.stamp_ns, "/imu", m) for m in imu.batches()),
            (Record(m.stamp_ns, "/odometry", m) for m in odometry),
            (Record(m.stamp_ns, "/gnss", m) for m in fixes),
            (Record(m.stamp_ns, "/truth", m) for m in true_odometry(motion, imu, span_ns)),
            (
                Record(shot.taken_ns + readout_ns, f"/{shot.camera}/image", image)
                for shot, image in studio.images(stamps_at(config.camera.rate_hz, span_ns))
            ),
            key=lambda record: record.log_ns,
        ),
    )


def vi_hall(config: WViConfig, seed: int) -> Hall:
    """Return the hall of a recording."""
    return hall(
        seed if config.hall_seed is None else config.hall_seed,
        eight(np.linspace(0, 2 * np.pi, 400)),
        texel_m=config.texel_m,
        num_tags=config.tags,
        tag_size_m=config.tag_size_m,
    )


def _tag_records(tags: tuple[Tag, ...]) -> list[Record]:
    if not tags:
        return []
    places = {f"tag36h11:{tag.id}": tag.T_world_tag for tag in tags}
    return [Record(START_NS, "/truth/tags", true_places(places, START_NS))]
