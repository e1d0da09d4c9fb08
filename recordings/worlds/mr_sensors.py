"""The sensors of one robot of W-MR at work: what each of them measures on its way."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from mapstream.recordings.worlds.building import building
from mapstream.recordings.worlds.building_tour import NUM_WAYS, tour
from mapstream.recordings.worlds.lens import Lens
from mapstream.recordings.worlds.mr_config import WMrConfig
from mapstream.recordings.worlds.mr_rig import (
    ROBOTS,
    T_BASE_LIDAR,
    T_BASE_RGBD,
)
from mapstream.recordings.worlds.photographs import in_order
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.renderer import Renderer
from mapstream.recordings.worlds.rgbd_camera import COLOR, DEPTH, RgbdCamera
from mapstream.recordings.worlds.satellites import satellite_fixes
from mapstream.recordings.worlds.sensors import Lidar, drifting_odometry, imu_series
from mapstream.recordings.worlds.simulated_detector import (
    SimulatedDetector,
    SimulatedDetectorConfig,
)
from mapstream.recordings.worlds.simulation import Record
from mapstream.recordings.worlds.slipping_wheels import wheel_odometry
from mapstream.recordings.worlds.studio import Studio
from mapstream.recordings.worlds.surface_mesh import mesh_of
from mapstream.recordings.worlds.truth import stamps_at, true_odometry, true_places
from mapstream.recordings.worlds.vi_rig import T_BASE_IMU
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration

START_NS = 1_700_000_000 * 10**9
_APART_NS = (
    100_000_000  # no two robots start at one moment, so that their missions have different ids
)
_ODOMETRY_HZ = 20.0


class MrSensors:
    """Streams of records, each in the order of log times, and each to be read once."""

    def __init__(self, config: WMrConfig, seed: int) -> None:
        self._config, self._robot = config, ROBOTS[config.robot]
        own = (seed, list(ROBOTS).index(config.robot), config.number)
        self._seed = int(np.random.SeedSequence(own).generate_state(1)[0])
        rngs = map(np.random.default_rng, np.random.SeedSequence(own).spawn(5))
        self._imu_rng, self._odometry_rng, self._wheel_rng, self._lidar_rng, self._fix_rng = rngs
        self._building = building(config.building_seed, texel_m=config.texel_m)
        start_ns = START_NS + (own[1] * NUM_WAYS + config.number) * _APART_NS
        self.span_ns = (start_ns, start_ns + round(config.duration_s * 1e9))
        self._motion = tour(
            self._building.rooms,
            config.number,
            config.duration_s,
            config.speed_mps,
            start_ns,
            is_carried=self._robot.is_carried,
        )
        self._imu = imu_series(config.imu, T_BASE_IMU, self._motion, self.span_ns, self._imu_rng)
        colored = self._robot.has_rgbd
        self._renderer = Renderer(self._building.surfaces if colored else self._building.in_grey())

    @property
    def calibrations(self) -> dict[str, CameraCalibration]:
        """Return how its cameras see, by their frames."""
        config = self._config
        if self._robot.has_rgbd:
            return {name: config.rgbd.calibration(name) for name in (COLOR, DEPTH)}
        return {name: config.camera.calibration(name) for name in self._robot.cameras}

    def truth(self) -> Iterator[Record]:
        imu = self._imu if self._robot.has_imu else None
        for each in true_odometry(self._motion, imu, self.span_ns):
            yield Record(each.stamp_ns, "/truth", each)

    def things(self) -> Iterator[Record]:
        places = {thing.name: thing.T_world_thing for thing in self._building.things}
        yield Record(self.span_ns[0], "/truth/things", true_places(places, self.span_ns[0]))

    def odometry(self) -> Iterator[Record]:
        stamps_ns = stamps_at(_ODOMETRY_HZ, self.span_ns)
        poses, drift = self._motion.poses(stamps_ns), self._config.odometry_drift
        for each in drifting_odometry(poses, stamps_ns, drift, self._odometry_rng):
            yield Record(each.stamp_ns, "/odometry", each)

    def inertial(self) -> Iterator[Record]:
        return (Record(each.stamp_ns, "/imu", each) for each in self._imu.batches())

    def wheels(self) -> Iterator[Record]:
        stamps_ns = stamps_at(self._config.wheels_hz, self.span_ns)
        poses, slip = self._motion.poses(stamps_ns), self._config.slip
        for each in wheel_odometry(poses, stamps_ns, slip, self._wheel_rng):
            yield Record(each.stamp_ns, "/wheels", each)

    def scans(self) -> Iterator[Record]:
        caster = RayCaster(mesh_of(self._building.surfaces))
        lidar = Lidar(self._config.lidar, T_BASE_LIDAR, self._lidar_rng)
        last_ns = self.span_ns[1] - lidar.period_ns
        for start_ns in range(self.span_ns[0], last_ns + 1, lidar.period_ns):
            scan = lidar.scan(caster, self._motion, start_ns)
            yield Record(start_ns + lidar.period_ns, "/points", scan)

    def fixes(self) -> Iterator[Record]:
        config = self._config.satellites
        stamps_ns = stamps_at(config.rate_hz, self.span_ns)
        for each in satellite_fixes(config, self._motion, stamps_ns, self._fix_rng):
            yield Record(each.stamp_ns, "/gnss", each)

    def images(self) -> Iterator[Record]:
        """Yield those of the stereo pair."""
        config, places = self._config.camera, self._robot.cameras
        studio = Studio(config, places, self._renderer, self._motion, self._seed, places)
        readout_ns = round(config.readout_s * 1e9)
        for shot, image in studio.images(stamps_at(config.rate_hz, self.span_ns)):
            yield Record(shot.taken_ns + readout_ns, f"/{shot.camera}/image", image)

    def depths(self) -> Iterator[Record]:
        """Yield images of colour and of depth, and clouds if they are asked for."""
        config = self._config.rgbd
        camera = RgbdCamera(config, self._renderer, T_BASE_RGBD, self._seed)
        stamps_ns = stamps_at(config.rate_hz, self.span_ns)
        poses = self._motion.poses(stamps_ns) @ T_BASE_RGBD.matrix
        shots = zip(range(len(poses)), stamps_ns.tolist(), poses, strict=True)
        for color, depth in in_order(lambda shot: camera.take(*shot), shots):
            yield Record(color.stamp_ns, "/color/image", color)
            yield Record(depth.stamp_ns, "/depth/image", depth)
            if config.clouds:
                yield Record(depth.stamp_ns, "/points", camera.cloud(color, depth))

    def objects(self, config: SimulatedDetectorConfig) -> Iterator[Record]:
        """Yield what a detector finds in some images of the first camera, and the truth of it."""
        frame, calibration = next(iter(self.calibrations.items()))
        place = next(iter(self._robot.cameras.values()), T_BASE_RGBD)
        lens, things = Lens(self._renderer, calibration), self._building.things
        surfaces = self._renderer.surfaces
        detector = SimulatedDetector(config, surfaces, things, frame, place, self._seed)
        rate_hz = (self._config.rgbd if frame == COLOR else self._config.camera).rate_hz
        step = max(1, round(rate_hz / self._config.objects_hz))
        stamps_ns = stamps_at(rate_hz, self.span_ns)[::step]
        poses = self._motion.poses(stamps_ns) @ place.matrix

        def found(number: int, stamp_ns: int, T: FloatArray) -> list[Record]:
            seen = detector.detect(lens.surfaces(T), things, T, number, stamp_ns)
            return [
                Record(stamp_ns, f"/{frame}/objects", seen.detections),
                Record(stamp_ns, "/truth/objects", seen.truth),
            ]

        shots = zip(range(len(poses)), stamps_ns.tolist(), poses, strict=True)
        return chain.from_iterable(in_order(lambda shot: found(*shot), shots))
