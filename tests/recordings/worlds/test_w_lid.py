"""World W-LID: repeatable, and true to its own truth."""

import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.corridor import Corridor
from mapstream.recordings.worlds.motion import GRAVITY_MPS2, Motion
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.sensors import (
    ImuConfig,
    LidarConfig,
    drifting_odometry,
    imu_batches,
)
from mapstream.recordings.worlds.w_lid import START_NS, T_BASE_IMU, WLidConfig, drive, w_lid
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3, invert, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.trajectory import Trajectory

SMALL: dict[str, Any] = {"length_m": 36.0, "speed_mps": 8.0, "lidar": {"beams": 4, "columns": 32}}
SILENT = ImuConfig(
    gyro_noise_radps_rthz=0,
    accel_noise_mps2_rthz=0,
    gyro_bias_radps=0,
    accel_bias_mps2=0,
    gyro_walk_radps2_rthz=0,
    accel_walk_mps3_rthz=0,
)


def in_world(scan: LidarScan, truth: Trajectory) -> FloatArray:
    """Put each point where the base truly was when it was measured; (N, 3)."""
    assert scan.offsets_ns is not None
    T = truth.at(scan.stamp_ns + scan.offsets_ns) @ scan.T_base_sensor.matrix
    points: FloatArray = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]
    return points


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    """Two simulations are equal byte for byte, and another seed's is not."""
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (3, 3, 4), strict=True):
        simulate("w_lid", path, seed=seed, **SMALL)

    a, b, c = (path.read_bytes() for path in paths)
    assert a == b
    assert a != c


def test_the_recording_holds_scans_imu_odometry_and_truth(tmp_path: Path) -> None:
    """All four topics are there, at their rates."""
    fractions: list[float] = []
    path = simulate("w_lid", tmp_path / "w.mcap", on_progress=fractions.append, **SMALL)

    with McapRecording(path) as recording:
        rates = {name: round(topic.frequency) for name, topic in recording.topics.items()}
    assert rates == {"/points": 10, "/imu": 10, "/odometry": 20, "/truth": 100}
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("aggressive", [False, True])
def test_I17_points_lie_on_the_walls_once_their_motion_is_undone(*, aggressive: bool) -> None:
    """With the true pose of each point's time the surface is found again, to the range noise.

    The same points with one pose per sweep are off by decimetres: the distortion is real.
    """
    lidar = LidarConfig(beams=8, columns=128, dropout=0.0)
    config = WLidConfig(length_m=40.0, aggressive=aggressive, lidar=lidar)
    records = list(islice(w_lid(config, 0).records, 800))
    truth = Trajectory(
        stamps_ns=np.array([r.log_ns for r in records if r.topic == "/truth"]),
        poses=np.array([r.message.T_odom_base.matrix for r in records if r.topic == "/truth"]),  # type: ignore[attr-defined]  # of that topic
    )
    scan = [r.message for r in records if r.topic == "/points"][50]
    assert isinstance(scan, LidarScan)
    world_rng = np.random.default_rng(np.random.SeedSequence(0).spawn(4)[0])
    caster = RayCaster(Corridor(Ring(40.0), world_rng).mesh())

    assert scan.offsets_ns is not None
    T = truth.at(scan.stamp_ns + scan.offsets_ns) @ scan.T_base_sensor.matrix
    origins, points = T[:, :3, 3], in_world(scan, truth)
    ranges = np.linalg.norm(points - origins, axis=1)
    hits = caster.cast(np.ascontiguousarray(origins), (points - origins) / ranges[:, None])
    assert np.median(np.abs(hits.ranges_m - ranges)) < 0.01  # the noise has 1 cm
    T_world_base = truth.pose_at(scan.stamp_ns)
    naive = T_world_base @ (scan.T_base_sensor @ scan.points)
    moved = np.linalg.norm(naive - points, axis=1)
    assert moved[-8:].max() > 0.15


def test_a_perfect_imu_integrates_to_the_truth() -> None:
    """Three seconds of noise-free samples lead from the true state to the true state."""
    motion = drive(Ring(40.0), WLidConfig(length_m=40.0))
    batches = list(imu_batches(SILENT, T_BASE_IMU, motion, np.random.default_rng(0)))
    stamps_ns = np.concatenate([b.stamps_ns for b in batches])[800:1401]
    gyro = np.concatenate([b.gyro_radps for b in batches])[800:1401]
    accel = np.concatenate([b.accel_mps2 for b in batches])[800:1401]
    T = motion.poses(stamps_ns) @ T_BASE_IMU.matrix
    h = 1_000_000
    ends = motion.poses(stamps_ns[0] + np.array([-h, h])) @ T_BASE_IMU.matrix

    R, p, v = T[0, :3, :3], T[0, :3, 3], (ends[1] - ends[0])[:3, 3] / (2e-9 * h)
    dt = 0.005
    for k in range(600):
        R_next = R @ so3_exp((gyro[k] + gyro[k + 1]) / 2 * dt)
        a = (R @ accel[k] + R_next @ accel[k + 1]) / 2 - [0, 0, GRAVITY_MPS2]
        p, v, R = p + v * dt + a * dt * dt / 2, v + a * dt, R_next

    np.testing.assert_allclose(p, T[-1, :3, 3], atol=2e-3)
    np.testing.assert_allclose(R, T[-1, :3, :3], atol=1e-4)


def test_a_resting_imu_feels_gravity_upwards() -> None:
    """During the standing start the accelerometer reads +g along z."""
    motion = drive(Ring(40.0), WLidConfig(length_m=40.0))

    force = motion.specific_force(np.array([START_NS + 400_000_000]), SE3.identity())

    np.testing.assert_allclose(force[0], [0, 0, GRAVITY_MPS2], atol=1e-4)


def test_the_odometry_drifts_by_half_a_percent() -> None:
    """Over a straight 15 m, the odometry of 20 seeds is wrong by 0.3 to 0.8 % on average."""
    motion = drive(Ring(150.0), WLidConfig(length_m=150.0))
    stamps_ns = motion.start_ns + np.arange(0, 10 * 10**9, 50_000_000)
    poses = motion.poses(stamps_ns)
    end = int(np.searchsorted(poses[:, 0, 3], 15.0))

    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        odometry = list(drifting_odometry(poses, stamps_ns, 0.005, rng))[end].T_odom_base.matrix
        errors.append(np.linalg.norm((invert(poses[end]) @ odometry)[:3, 3]) / 15.0)

    assert 0.003 < np.mean(errors) < 0.008


def test_aggressive_motion_spins_at_90_degrees_per_second() -> None:
    """The turn rate reaches 90 deg/s to both sides, and stays there for most of the time."""
    motion = drive(Ring(120.0), WLidConfig(length_m=120.0, aggressive=True))
    stamps_ns = np.arange(motion.start_ns + 5 * 10**9, motion.end_ns, 20_000_000)

    rates = np.rad2deg(motion.angular_velocity(stamps_ns)[:, 2])
    assert np.median(np.abs(rates)) > 80
    assert rates.min() < -80
    assert rates.max() > 80


def test_blank_walls_say_nothing_along_the_corridor() -> None:
    """In the middle of a straight blank corridor all normals are square to its axis."""
    mesh = Corridor(Ring(120.0), np.random.default_rng(0), is_blank=True).mesh()
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    near = np.linalg.norm(centres[:, :2], axis=1) < 8

    assert np.abs(mesh.normals()[near, 0]).max() < 1e-9


def test_the_ring_closes_at_even_speed() -> None:
    """A lap ends where it began, turned once around, and distances along it are metres."""
    ring = Ring(300.0)
    s = np.linspace(0, 300, 3001)
    points = ring.points(s, 0.0, 0.0)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)

    np.testing.assert_allclose(points[-1], points[0], atol=1e-9)
    np.testing.assert_allclose(steps, 0.1, rtol=1e-4)
    assert ring.headings(s)[-1] == pytest.approx(2 * np.pi)


def test_a_motion_is_not_extrapolated() -> None:
    """A stamp outside is refused, and the message says what the motion spans."""
    stamps_ns = np.arange(8) * 10**9
    motion = Motion(stamps_ns, np.zeros((8, 3)), np.zeros((8, 3)))

    with pytest.raises(ValueError, match="outside the motion, 0 to 7000000000"):
        motion.poses(np.array([8 * 10**9]))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("w_lidar", {}, "no world 'w_lidar'; there are w_2d, w_lid"),
        ("w_lid", {"lenght_m": 40}, r"w_lid.lenght_m: Extra inputs .*; options are length_m"),
        ("w_lid", {"lidar": {"beams": -1}}, r"w_lid.lidar.beams: Input should be greater than 0"),
        ("w_lid", {"length_m": 5}, r"w_lid.length_m: Input should be greater than or equal to 36"),
    ],
)
def test_refuses_unknown_worlds_and_options(
    tmp_path: Path, name: str, options: dict[str, Any], message: str
) -> None:
    """A mistake is named before a file is made."""
    with pytest.raises(ConfigError, match=message):
        simulate(name, tmp_path / "x.mcap", **options)

    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.slow
def test_R9_the_world_is_made_within_a_minute(tmp_path: Path) -> None:
    """At the pace of the first 40 sweeps of the 300 m loop, all take less than 60 s of one core."""
    config = WLidConfig(length_m=300.0)
    simulation = w_lid(config, 0)
    num_sweeps = (simulation.end_ns - simulation.start_ns) // 10**8
    started = time.process_time()
    count = 0
    for record in simulation.records:
        count += record.topic == "/points"
        if count == 40:
            break

    seconds = (time.process_time() - started) * num_sweeps / 40
    assert seconds < 60


def test_an_interrupted_simulation_leaves_no_file(tmp_path: Path) -> None:
    """Half a world is no world."""

    def stop(fraction: float) -> None:
        if fraction > 0.1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate("w_lid", tmp_path / "w.mcap", on_progress=stop, **SMALL)

    assert list(tmp_path.iterdir()) == []


def test_several_drives_share_a_building() -> None:
    """Another start, the other way round, other noise: the corridors are the same."""
    shared = {**SMALL, "building": 3}
    drives = (
        (SMALL, 3),
        ({**shared, "start_fraction": 0.5}, 9),
        ({**shared, "reverse": True}, 9),
        (SMALL, 9),
    )
    poses, reach_m = [], []
    for options, seed in drives:
        records = list(islice(w_lid(WLidConfig.model_validate(options), seed).records, 400))
        truth = next(r.message for r in records if r.topic == "/truth")
        scan = next(r.message for r in records if r.topic == "/points")
        assert isinstance(truth, Odometry)
        assert isinstance(scan, LidarScan)
        poses.append(truth.T_odom_base)
        reach_m.append(float(np.linalg.norm(scan.points, axis=1).max()))

    across = Ring(SMALL["length_m"]).points(np.array([18.0]), 0.0, 0.0)[0]
    assert np.allclose(poses[1].t[:2], across[:2], atol=0.2)
    assert np.allclose(poses[2].R[:2, :2], -np.eye(2), atol=0.01)
    assert abs(reach_m[2] - reach_m[0]) < abs(reach_m[3] - reach_m[0])
