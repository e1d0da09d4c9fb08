"""KITTI 00 from the installed gtsam: its stamps, axes, noise and positions are what they say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.attached_rig import attached_rig, rig_of
from mapstream.recordings.datasets.catalogue import Conversion, convert
from mapstream.recordings.datasets.kitti_inertial import gtsam_data
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.geometry import invert, se3_log
from mapstream.streams.sensors import ImuSensor


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    return convert("kitti00-gtsam", tmp_path_factory.mktemp("kitti") / "drive.mcap")


def decoded(path: Path, topic: str) -> list[Any]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


def test_the_imu_runs_without_gaps_and_feels_gravity_along_z(drive: Conversion) -> None:
    batches = decoded(drive.path, "/imu")
    stamps_ns = np.concatenate([batch.stamps_ns for batch in batches])
    accel = np.concatenate([batch.accel_mps2 for batch in batches])

    assert len(stamps_ns) == 46967
    assert stamps_ns[0] == pytest.approx(46536_397971133, abs=2)
    assert np.diff(stamps_ns).min() > 0
    assert np.diff(stamps_ns).max() < 100_000_000
    np.testing.assert_allclose(accel.mean(axis=0), [0, 0, 9.8], atol=0.3)
    assert any("1 IMU samples and 1 positions" in notice for notice in drive.notices)
    assert any("VO_stereo_factors" in notice for notice in drive.notices)


def test_positions_are_constraints_in_a_frame_of_their_own(drive: Conversion) -> None:
    fixes = decoded(drive.path, "/gps")
    positions = np.array([fix.T_a_b.t for fix in fixes])

    assert len(fixes) == 469
    assert {(fix.kind, fix.outer.name, fix.outer.T_map_frame) for fix in fixes} == {
        ("position", "gps", None)
    }
    np.testing.assert_array_equal(np.diagonal(fixes[0].covariance), [np.inf] * 3 + [0.07] * 3)
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() == pytest.approx(3700, rel=0.02)


def test_the_camera_turns_as_the_gyroscope_does(drive: Conversion) -> None:
    """Its poses have no stamps of their own; axes and stamps are right where the yaw rates agree."""
    batches, poses = decoded(drive.path, "/imu"), decoded(drive.path, "/visual_odometry")
    imu_s = np.concatenate([batch.stamps_ns for batch in batches]) * 1e-9
    gyro = np.concatenate([batch.gyro_radps for batch in batches])
    pose_s = np.array([pose.stamp_ns for pose in poses]) * 1e-9
    T = np.array([pose.T_odom_base.matrix for pose in poses])

    turned = se3_log(invert(T[:-1]) @ T[1:])[:, 2] / np.diff(pose_s)
    felt = np.interp((pose_s[1:] + pose_s[:-1]) / 2, imu_s, gyro[:, 2])

    assert np.abs(felt).max() > 0.3
    assert np.sqrt(np.mean((turned - felt) ** 2)) < 0.02
    assert (invert(T[:-1]) @ T[1:])[:, 0, 3].min() > 0.2  # forward is x


def test_the_sensor_file_travels_in_the_recording(drive: Conversion, tmp_path: Path) -> None:
    rig = rig_of(drive.path)
    imu = rig.select("imu")

    assert isinstance(imu, ImuSensor)
    assert imu.noise is not None
    assert (imu.noise.accel_density, imu.noise.gyro_density) == (0.01, 0.000175)
    assert (imu.noise.accel_random_walk, imu.noise.gyro_random_walk) == (0.000167, 2.91e-06)
    with McapWriter(tmp_path / "bare.mcap"):
        pass
    with open_recording(tmp_path / "bare.mcap") as recording:
        assert attached_rig(recording) is None
    with pytest.raises(ConfigError, match=r"bare\.mcap: no sensors\.yaml is attached"):
        rig_of(tmp_path / "bare.mcap")


def test_damaged_files_are_refused_by_name(tmp_path: Path) -> None:
    for name in ("KittiEquivBiasedImu.txt", "KittiEquivBiasedImu_metadata.txt"):
        (tmp_path / name).write_bytes((gtsam_data() / name).read_bytes()[:2000])
    (tmp_path / "KittiGps_converted.txt").write_text("Time,X,Y,Z\n1,2,x,4\n")

    with pytest.raises(RecordingError, match=r"KittiGps_converted\.txt: expected rows of numbers"):
        convert(f"kitti00-gtsam:{tmp_path}", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
