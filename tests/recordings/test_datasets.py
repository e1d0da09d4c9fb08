"""Data sets as MCAP: what is in the source is in the recording, and nothing else."""

from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.recordings.trajectory_files import read_tum, write_kitti, write_tum
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.trajectory import Trajectory
from tests.data import shared

ROWS = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 1], [-4, 5, -6, 0.25]], dtype=np.float32)


def decoded(path: Path, topic: str) -> list[object]:
    with open_recording(path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        return [decode(message) for message in recording.messages([topic])]


def scans_of(path: Path) -> list[LidarScan]:
    return [message for message in decoded(path, "/points") if isinstance(message, LidarScan)]


def poses_of(path: Path, topic: str) -> list[Odometry]:
    return [message for message in decoded(path, topic) if isinstance(message, Odometry)]


def test_kitti_folder_with_times_calibration_and_poses(tmp_path: Path) -> None:
    """Stamps are those of times.txt, the truth is the LiDAR's, and lost points are counted."""
    (tmp_path / "velodyne").mkdir()
    for index in range(2):
        ROWS.tofile(tmp_path / "velodyne" / f"{index:06d}.bin")
    (tmp_path / "times.txt").write_text("0.0\n1.036224e-01\n2.0\n")
    T_camera_lidar = SE3.exp([1.2, -1.2, 1.2, 0.1, 0.2, 0.3])
    numbers = " ".join(map(str, T_camera_lidar.matrix[:3].ravel()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 0 0\nTr: {numbers}\n")
    cameras = se3_exp(np.array([[0.0] * 6, [0.1, 0.2, 0.3, 1, 2, 3], [0.1] * 6]))
    write_kitti(tmp_path / "poses.txt", Trajectory(stamps_ns=np.arange(3), poses=cameras))

    conversion = convert(f"kitti:{tmp_path}", tmp_path / "out.mcap")

    scans, truth = scans_of(conversion.path), poses_of(conversion.path, "/truth")
    assert [scan.stamp_ns for scan in scans] == [0, 103_622_400]
    np.testing.assert_array_equal(scans[1].points, ROWS[[0, 2], :3])
    assert scans[1].intensity is not None
    np.testing.assert_array_equal(scans[1].intensity, [0.5, 0.25])
    assert scans[1].offsets_ns is None
    expected = T_camera_lidar.inverse() @ SE3(cameras[1]) @ T_camera_lidar
    np.testing.assert_allclose(truth[1].T_odom_base.matrix, expected.matrix, atol=1e-9)
    assert conversion.num_messages == 4
    assert conversion.notices == ("2 points that were not finite were left out",)


def test_real_kitti_scans(tmp_path: Path) -> None:
    """Four HDL-64 scans, nominal stamps, and poses that are left out for want of a calibration."""
    source = shared("kitti00_lidar")
    scan = np.fromfile(source / "000003.bin", np.float32).reshape(-1, 4)
    out = tmp_path / "kitti.mcap"

    conversion = convert(f"kitti:{source}", out)

    scans = scans_of(out)
    assert [s.stamp_ns for s in scans] == [100_000_000, 200_000_000, 300_000_000, 400_000_000]
    np.testing.assert_array_equal(scans[3].points, scan[:, :3])
    assert "no times.txt: stamps are nominal, 10 Hz" in conversion.notices
    assert any("no calib.txt" in notice for notice in conversion.notices)


def test_real_lidar_bins(tmp_path: Path) -> None:
    """Scans take the stamps of their poses; all poses become the reference."""
    source = shared("indoor_lidar_2hz")

    convert(f"lidar_bins:{source}", tmp_path / "out.mcap")

    scans, reference = (
        scans_of(tmp_path / "out.mcap"),
        poses_of(tmp_path / "out.mcap", "/reference"),
    )
    assert len(scans) == 30
    assert scans[0].stamp_ns == reference[0].stamp_ns == 1630577758_569490000
    np.testing.assert_allclose(np.diff([s.stamp_ns for s in scans]), 5e8, atol=1e7)
    np.testing.assert_allclose(reference[1].T_odom_base.t, [-0.000948, -0.004086, -0.002842])


def test_real_rosbag_keeps_every_byte(tmp_path: Path) -> None:
    """A ROS 1 bag as MCAP has the same messages of the same channels."""
    source = shared("husky/husky_ros1.bag")

    conversion = convert(f"rosbag:{source}", tmp_path / "out.mcap")

    def content(path: Path) -> list[tuple[str, int, bytes]]:
        with open_recording(path) as recording:
            return sorted((m.topic, m.log_ns, bytes(m.data)) for m in recording.messages())

    assert content(tmp_path / "out.mcap") == content(source)
    assert conversion.notices == ()


def test_tum_trajectory_as_odometry(tmp_path: Path) -> None:
    """Every pose is a message; the fraction done ends at one."""
    stamps_ns = 10**18 + np.arange(5) * 10**7
    trajectory = Trajectory(stamps_ns=stamps_ns, poses=se3_exp(np.ones((5, 6)) * 0.1))
    write_tum(tmp_path / "t.tum", trajectory)
    fractions: list[float] = []

    convert(f"tum:{tmp_path / 't.tum'}", tmp_path / "out.mcap", on_progress=fractions.append)

    messages = poses_of(tmp_path / "out.mcap", "/odometry")
    assert [message.stamp_ns for message in messages] == stamps_ns.tolist()
    poses = read_tum(tmp_path / "t.tum").poses
    np.testing.assert_array_equal([m.T_odom_base.matrix for m in messages], poses)
    assert fractions[-1] == 1


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (
            "velodyne:x",
            r"'velodyne:x' is no source to convert; expected one of csv:PATH, .*tum:PATH",
        ),
        ("x", "'x' is no source"),
        ("kitti:/nowhere/at/all", "there is nothing at /nowhere/at/all"),
    ],
)
def test_refuses_unknown_sources(tmp_path: Path, spec: str, message: str) -> None:
    """The message says what there is."""
    with pytest.raises(ConfigError, match=message):
        convert(spec, tmp_path / "out.mcap")


def test_a_failed_conversion_leaves_the_old_file(tmp_path: Path) -> None:
    """A scan of 15 bytes is named, and what was there stays."""
    (tmp_path / "in").mkdir()
    ROWS.tofile(tmp_path / "in" / "0.bin")
    (tmp_path / "in" / "1.bin").write_bytes(b"x" * 15)
    (tmp_path / "out.mcap").write_bytes(b"old")

    with pytest.raises(
        RecordingError, match=r"1\.bin: expected points of 16 bytes .* found 15 bytes"
    ):
        convert(f"kitti:{tmp_path / 'in'}", tmp_path / "out.mcap")

    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out.mcap"]
    assert (tmp_path / "out.mcap").read_bytes() == b"old"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("times.txt", "0.0\n", r"times\.txt: expected a time for each of 2 frames, found 1"),
        ("calib.txt", "P0: 1\n", r"calib\.txt: expected a line 'Tr: \.\.\.'"),
        ("calib.txt", "Tr: 1 2\n", r"calib\.txt: Tr: expected 12 numbers"),
        ("poses.txt", "1 2 3\n", r"poses\.txt:1: expected 12 numbers, found 3"),
    ],
)
def test_refuses_incomplete_kitti(tmp_path: Path, name: str, content: str, message: str) -> None:
    """The message names the file, and the line where there is one."""
    for index in range(2):
        ROWS.tofile(tmp_path / f"{index}.bin")
    pose = Trajectory(stamps_ns=np.array([0]), poses=np.eye(4)[None])
    write_kitti(tmp_path / "poses.txt", pose)
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / name).write_text(content)

    with pytest.raises(RecordingError, match=message):
        convert(f"kitti:{tmp_path}", tmp_path / "out.mcap")


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("1,0,0,0\n0,1,0,0\n0,0,1,0\n0,0,0,5\n", "expected a pose for each of 2 scans, found 1"),
        ("1,0,0,0\n0,1,0,0\n", r"alidarPose\.csv:1: expected four lines of four numbers"),
        ("1,0,0,x\n0,1,0,0\n0,0,1,0\n0,0,0,5\n", r"alidarPose\.csv:1: expected four lines"),
    ],
)
def test_refuses_incomplete_lidar_bins(tmp_path: Path, poses: str, message: str) -> None:
    """Scans without poses have no stamps."""
    for index in range(2):
        ROWS.tofile(tmp_path / f"{index}.bin")
    (tmp_path / "alidarPose.csv").write_text(poses)

    with pytest.raises(RecordingError, match=message):
        convert(f"lidar_bins:{tmp_path}", tmp_path / "out.mcap")
