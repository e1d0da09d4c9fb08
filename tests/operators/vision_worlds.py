"""Small maps whose truth is exact: a robot that turns and climbs before a wall of points, with cameras and an IMU."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace

import numpy as np

from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.cameras import Camera, with_cameras
from mapstream.recordings.maps.ids import derived_id, id_array, id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges, ImuSamples, Landmarks, Observations, Vertices
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3, invert, se3_exp, so3_exp, so3_log

MISSION = "5a" * 16
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of a camera that looks along x
GRAVITY = np.array([0.0, 0.0, -9.81])
PINHOLE = CameraCalibration(
    width_px=640, height_px=480, focal_px=np.array([400.0, 405.0]),
    center_px=np.array([322.0, 238.0]), distortion_parameters=np.zeros(0),
)  # fmt: skip


def mounted(t: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> SE3:
    return SE3.from_rotation(so3_exp(turn) @ OPTICAL, t)


def stereo(calibration: CameraCalibration = PINHOLE, baseline_m: float = 0.3) -> dict[str, Camera]:
    """Two cameras side by side, not quite parallel."""
    return {
        "left": Camera(calibration=replace(calibration, frame="left"), T_base_sensor=mounted((0.1, baseline_m / 2, 0.05))),
        "right": Camera(calibration=replace(calibration, frame="right"), T_base_sensor=mounted((0.1, -baseline_m / 2, 0.05), (0.01, -0.02, 0.03))),
    }  # fmt: skip


def poses_at(times_s: FloatArray, tilt: float = 1.0) -> FloatArray:
    """Where the base is (N, 4, 4): it sways in all six directions, and rolls and pitches more with more tilt."""
    t = np.asarray(times_s, dtype=np.float64)
    waves = np.stack([
        1.2 * np.sin(0.9 * t), 1.5 * np.sin(0.7 * t), 0.5 * np.sin(1.3 * t),
        tilt * 0.15 * np.sin(1.1 * t), tilt * 0.2 * np.sin(0.8 * t), 0.35 * np.sin(0.6 * t),
    ], axis=1)  # fmt: skip
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = so3_exp(waves[:, 3:]), waves[:, :3]
    return T


def imu_at(times_s: FloatArray, tilt: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rates, specific forces and velocities (N, 3), by differences."""
    h, G = 1e-4, GRAVITY
    before, now, after = (poses_at(times_s + dt, tilt) for dt in (-h, 0, h))
    gyro = so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2 * h)
    acceleration = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / h**2
    R_base_map = np.swapaxes(now[:, :3, :3], 1, 2)
    force: FloatArray = (R_base_map @ (acceleration - G)[:, :, None])[:, :, 0]
    return gyro, force, velocity


@dataclass
class World:
    """What is true, and what a map of it shall look like."""

    cameras: dict[str, Camera] = field(default_factory=stereo)
    num_vertices: int = 20
    step_s: float = 0.25
    num_points: int = 150
    noise_px: float = 0.0
    seed: int = 0
    start_s: float = 0.0
    tilt: float = 1.0
    late_s: float = 0.0  # how long after its stamp an image was really taken
    kind: str = "brisk"
    mission: str = MISSION
    points: FloatArray = field(init=False)
    times_s: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.points = rng.uniform([4, -4, -2.5], [8, 4, 2.5], (self.num_points, 3))
        self.times_s = self.start_s + self.step_s * np.arange(self.num_vertices, dtype=np.float64)
        self.rng = rng

    @property
    def poses(self) -> FloatArray:
        return poses_at(self.times_s, self.tilt)

    @property
    def stamps_ns(self) -> IntArray:
        return np.rint(self.times_s * 1e9).astype(np.int64) + 1_000_000_000

    def map(self, base: Map | None = None) -> Map:
        """Return a map with true poses, an observation of each point that a camera sees, and no landmarks."""
        map_ = new_mission(base or Map.empty(), self.mission)
        row = len(map_.missions) - 1
        first = len(map_.vertices)
        vertices = Vertices(
            id=id_array(vertex_id(id_bytes(self.mission), s) for s in self.stamps_ns.tolist()),
            mission=np.full(self.num_vertices, row),
            stamp_ns=self.stamps_ns,
            T_mission_base=self.poses,
        )
        map_ = replace(map_, vertices=concatenate([map_.vertices, vertices]))
        map_ = with_cameras(map_, row, self.cameras)
        seen = [self.observations(name, first) for name in self.cameras]
        return replace(map_, observations=concatenate([map_.observations, *seen]))

    def observations(self, name: str, first: int = 0) -> Observations:
        """What one camera saw, row after row where its shutter rolls."""
        camera = self.cameras[name]
        delay_s = camera.calibration.line_delay_ns / 1e9
        parts = []
        for vertex, time_s in enumerate(self.times_s.tolist()):
            base_s = time_s + self.late_s
            px, is_seen, p = self._pictured(camera, np.full(self.num_points, base_s))
            for _ in range(5 if delay_s else 0):
                at_s = base_s + np.nan_to_num(px[:, 1]) * delay_s
                px, is_seen, p = self._pictured(camera, at_s)
            size = [camera.calibration.width_px - 1, camera.calibration.height_px - 1]
            is_seen &= ((px >= 0) & (px <= size)).all(axis=1)
            parts.append((vertex, np.flatnonzero(is_seen), px[is_seen], p[is_seen]))
        track = np.concatenate([t for _, t, _, _ in parts])
        px = np.concatenate([each for _, _, each, _ in parts])
        return Observations(
            vertex=first + np.concatenate([np.full(len(t), v) for v, t, _, _ in parts]),
            landmark=np.full(len(track), -1),
            sensor=np.full(len(track), name, object),
            kind=np.full(len(track), self.kind, object),
            keypoint_px=(px + self.noise_px * self.rng.normal(size=px.shape)).astype(np.float32),
            sigma=np.full(len(track), max(self.noise_px, 0.1)),
            track=track,
        )

    def _pictured(
        self, camera: Camera, at_s: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        T = poses_at(at_s, self.tilt) @ camera.T_base_sensor.matrix
        p = np.einsum("nji,nj->ni", T[:, :3, :3], self.points - T[:, :3, 3])
        return *project(camera.calibration, p), p

    def with_odometry(
        self, map_: Map, sigma_rad: float = 0.002, sigma_m: float = 0.01, *, noisy: bool = True
    ) -> Map:
        """Return the map with odometry between consecutive vertices, and poses as odometry has them."""
        sigmas = np.repeat([sigma_rad, sigma_m], 3)
        truth = self.poses
        steps = invert(truth[:-1]) @ truth[1:]
        if noisy:
            steps = steps @ se3_exp(self.rng.normal(size=(len(steps), 6)) * sigmas)
        poses = [truth[0]]
        for step in steps:
            poses.append(poses[-1] @ step)
        num, first = len(steps), len(map_.vertices) - self.num_vertices
        edges = Edges(
            kind=np.full(num, "odometry", object),
            vertex_a=first + np.arange(num),
            vertex_b=first + np.arange(1, num + 1),
            T_a_b=steps,
            covariance=np.tile(np.diag(sigmas**2), (num, 1, 1)),
        )
        all_poses = map_.vertices.T_mission_base.copy()
        all_poses[first:] = poses
        map_ = replace(map_, vertices=replace(map_.vertices, T_mission_base=all_poses))
        return append_edges(map_, edges)

    def with_imu(self, map_: Map, rate_hz: int = 200) -> Map:
        """Return the map with exact samples between consecutive vertices, and their velocities."""
        num = self.num_vertices - 1
        first_edge = len(map_.edges)
        edges = Edges(
            kind=np.full(num, "imu", object),
            vertex_a=np.arange(num),
            vertex_b=np.arange(1, num + 1),
        )
        map_ = append_edges(map_, edges)
        per = round(self.step_s * rate_hz) + 1
        times = (self.times_s[:-1, None] + np.linspace(0, self.step_s, per)).ravel()
        gyro, force, _ = imu_at(times, self.tilt)
        samples = ImuSamples(
            edge=first_edge + np.repeat(np.arange(num), per),
            stamp_ns=np.rint(times * 1e9).astype(np.int64) + 1_000_000_000,
            gyro_radps=gyro,
            accel_mps2=force,
        )
        _, _, velocities = imu_at(self.times_s, self.tilt)
        described = json.loads(map_.missions.sensors[0]) | {
            "imu": {"gyro_density": 1e-4, "accel_density": 1e-3, "gyro_random_walk": 1e-6, "accel_random_walk": 1e-5}
        }  # fmt: skip
        return replace(
            map_,
            imu=concatenate([map_.imu, samples]),
            vertices=replace(map_.vertices, velocity_mps=velocities),
            missions=replace(map_.missions, sensors=np.array([json.dumps(described)], object)),
        )


def with_true_landmarks(world: World, map_: Map, kind: str = "brisk") -> Map:
    """Return the map, whose poses are true, with a landmark where each point is, seen by all of its track."""
    seen = np.unique(map_.observations.track)
    homes = np.array([map_.observations.vertex[map_.observations.track == t][0] for t in seen])
    T = invert(map_.T_map_base(homes))
    p = np.einsum("nij,nj->ni", T[:, :3, :3], world.points[seen]) + T[:, :3, 3]
    added = Landmarks(
        id=id_array(derived_id("landmark", int(t)) for t in seen),
        kind=np.full(len(seen), kind, object),
        vertex=homes,
        p_base=p,
    )
    landmark = len(map_.landmarks) + np.searchsorted(seen, map_.observations.track)
    return replace(
        map_,
        landmarks=concatenate([map_.landmarks, added]),
        observations=replace(map_.observations, landmark=landmark),
    )


def landmark_errors_m(world: World, map_: Map) -> FloatArray:
    """Return how far (L,) each landmark is from the point behind its track."""
    track = np.full(len(map_.landmarks), -1)
    has = map_.observations.landmark >= 0
    track[map_.observations.landmark[has]] = map_.observations.track[has]
    p = map_.T_map_landmark(np.arange(len(track)))[:, :3, 3]
    return np.asarray(np.linalg.norm(p - world.points[track], axis=1))


def position_errors_m(world: World, map_: Map) -> FloatArray:
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    return np.asarray(np.linalg.norm(poses[:, :3, 3] - world.poses[:, :3, 3], axis=1))
