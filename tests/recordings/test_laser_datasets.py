"""Logs of planar lasers as MCAP: scans, wheel odometry, and what was lost is counted."""

import bz2
import gzip
import struct
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.datasets.catalogue import Conversion, convert
from mapstream.recordings.datasets.mines import dead_reckoned
from mapstream.recordings.datasets.planar_laser import repaired_stamps
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.recordings.trajectory_files import read_corrected
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LaserScan2D, TransformBatch, WheelOdometry
from tests.data import shared

M = TypeVar("M")


def decoded(conversion: Conversion, topic: str, kind: type[M]) -> list[M]:
    with open_recording(conversion.path) as recording:
        decode = decoder_for(recording.topics[topic].channel)
        found = [decode(message) for message in recording.messages([topic])]
    assert all(isinstance(message, kind) for message in found)
    return [message for message in found if isinstance(message, kind)]


def flaser(ranges: str, pose: str, stamp: float) -> str:
    return f"FLASER {len(ranges.split())} {ranges} {pose} {pose} {stamp:.6f} host {stamp:.6f}\n"


CARMEN = (
    "# message formats defined: PARAM FLASER\n"
    "PARAM robot_frontlaser_offset 0.2 nohost 0\n"
    + flaser("1.5 81.83 2.5 3.5", "0 0 0", 10.0)
    + "ODOM 0 0 0 0 0 0 10.05 host 10.05\n"
    + flaser("1.5 2.0 2.5 3.5", "1 0 0.5", 9.0)
    + flaser("1.5 2.0 2.5 3.5", "2 0 0.5", 12.0)
    + "FLASER 4 1.0 2.0 broken\n"
)


@pytest.mark.parametrize("suffix", [".log", ".clf.bz2"])
def test_carmen_log_with_stamps_that_run_backwards(tmp_path: Path, suffix: str) -> None:
    """Lines keep their order, codes are no ranges, and the corrected poses go to the lines they name."""
    file = tmp_path / f"made{suffix}"
    file.write_bytes(bz2.compress(CARMEN.encode()) if suffix == ".clf.bz2" else CARMEN.encode())
    (tmp_path / "made_gt.txt").write_text("# line stamp x y yaw\n2 12.0 5.0 6.0 0.1\n")

    done = convert(f"carmen:{file}", tmp_path / "out.mcap")

    scans = decoded(done, "/scan", LaserScan2D)
    wheels = decoded(done, "/odom", WheelOdometry)
    truth = decoded(done, "/truth", Odometry)
    place = decoded(done, "/tf_static", TransformBatch)[0]
    stamps = [scan.stamp_ns for scan in scans]
    assert len(stamps) == 3
    assert sorted(set(stamps)) == stamps
    assert stamps[-1] == 12 * 10**9
    np.testing.assert_array_equal(scans[0].ranges_m, np.array([1.5, np.nan, 2.5, 3.5], np.float32))
    assert scans[0].angle_min_rad == pytest.approx(-np.pi / 2)
    assert scans[0].angle_step_rad == pytest.approx(np.pi / 4)
    np.testing.assert_allclose([w.T_odom_base.t[0] for w in wheels], [0, 1, 2])
    assert [pose.stamp_ns for pose in truth] == [stamps[2]]
    np.testing.assert_allclose(truth[0].T_odom_base.t, [5, 6, 0])
    assert (place.parents, place.children) == (("base_link",), ("laser",))
    np.testing.assert_allclose(place.T_parent_child[0, :3, 3], [0.2, 0, 0])
    assert done.notices == (
        "1 stamps of 3 that ran backwards were repaired",
        "1 lines ODOM were left out",
        "1 lines that cannot be read were left out",
    )


def test_carmen_robot_laser(tmp_path: Path) -> None:
    """A line of its own format says where the laser sits, and how its beams lie."""
    line = "ROBOTLASER1 0 -1.57 3.14 0.0175 20.0 0.01 0 3 1.0 20.0 2.0 0 1.3 0 0 1.0 0 0 0 0 0 0 0 7.5 host 0.1\n"
    file = tmp_path / "robot.log"
    file.write_text(line)

    done = convert(f"carmen:{file}", tmp_path / "out.mcap")

    scan = decoded(done, "/scan", LaserScan2D)[0]
    np.testing.assert_array_equal(scan.ranges_m, np.array([1.0, np.nan, 2.0], np.float32))
    assert (scan.angle_min_rad, scan.angle_step_rad) == (-1.57, 0.0175)
    place = decoded(done, "/tf_static", TransformBatch)[0]
    np.testing.assert_allclose(place.T_parent_child[0, :3, 3], [0.3, 0, 0], atol=1e-12)


@pytest.mark.parametrize("kind", ["carmen", "mines", "rawlog"])
def test_files_without_scans_are_refused(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "made.log"
    file.write_text("ODOM 0 0 0 0 0 0 10.05 host 10.05\n")

    with pytest.raises(RecordingError, match=r"made\.log: expected"):
        convert(f"{kind}:{file}", tmp_path / "out.mcap")


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=40))
def test_repaired_stamps_increase(stamps: list[int]) -> None:
    """They increase strictly, and stamps that were right stay."""
    repaired, num_changed = repaired_stamps([stamp * 10**9 for stamp in stamps])

    assert (np.diff(repaired) > 0).all()
    if sorted(set(stamps)) == stamps:
        assert num_changed == 0
        assert (repaired // 10**9).tolist() == stamps


def test_one_late_clock_does_not_bend_the_others() -> None:
    repaired, num_changed = repaired_stamps([10, 20, 90, 40, 50])

    assert (repaired.tolist(), num_changed) == ([10, 20, 30, 40, 50], 1)


def test_mines_log(tmp_path: Path) -> None:
    """Wheels that turn alike drive straight; codes and beams that see the robot are no ranges."""
    beams = np.full(682, 2000)
    beams[340] = 7
    rows = [[10**6 * k, 0, 1000 * k, 1000 * k, *[0] * 20, *beams] for k in (1, 2)]
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    (tmp_path / "made.dat").write_text(text + "1 2 3\n")

    done = convert(f"mines:{tmp_path / 'made.dat'}", tmp_path / "out.mcap")

    scan = decoded(done, "/scan", LaserScan2D)[1]
    wheels = decoded(done, "/odom", WheelOdometry)
    assert scan.stamp_ns == 2 * 10**9
    assert np.isnan(scan.ranges_m[[0, 69, 340, 681]]).all()
    np.testing.assert_array_equal(scan.ranges_m[70:340], np.float32(2.0))
    np.testing.assert_allclose(wheels[1].T_odom_base.t, [np.pi * 0.077, 0, 0])
    assert done.notices == ("1 lines that cannot be read were left out",)


def test_wheels_that_turn_against_each_other_turn_on_the_spot() -> None:
    poses = dead_reckoned(np.array([[0.0, 0.0], [-1000.0, 1000.0]]))

    np.testing.assert_allclose(poses[1], [0, 0, 2 * np.pi * 0.077 / 0.330], atol=1e-12)


def mrpt(name: str, version: int, content: bytes) -> bytes:
    """Return an object as MRPT writes it."""
    return bytes([0x80 | len(name)]) + name.encode() + bytes([version]) + content + b"\x88"


def mrpt_scan(ranges: list[float], seconds: int) -> bytes:
    place = mrpt("CPose3D", 2, struct.pack("<7d", 0.5, 0, 0.3, 1, 0, 0, 0))
    ticks = (11_644_473_600 + seconds) * 10**7
    content = struct.pack("<fBf", np.pi, 1, 80.0) + place + struct.pack("<I", len(ranges))
    content += np.array(ranges, "<f4").tobytes() + bytes(r < 80 for r in ranges)
    content += struct.pack("<fQfId", 0.01, ticks, 0.004, 0, 0.0)
    return mrpt("CObservation2DRangeScan", 6, content)


def mrpt_step(x: float, seconds: int) -> bytes:
    pose = mrpt("CPose2D", 1, struct.pack("<3d", x, 0.0, 0.0))
    ticks = (11_644_473_600 + seconds) * 10**7
    content = struct.pack("<i", 0) + pose + bytes(4 + 24 + 4 + 24 + 1 + 8 + 1 + 8)
    return mrpt("CActionRobotMovement2D", 6, content + struct.pack("<Q", ticks))


def one(name: str, version: int, content: bytes) -> bytes:
    return mrpt(name, version, struct.pack("<I", 1) + content)


RAWLOG = (
    one("CSensoryFrame", 2, mrpt_scan([1.0, 81.0, 2.0], 10))
    + one("CActionCollection", 0, mrpt_step(0.5, 11))
    + one("CSensoryFrame", 2, mrpt_scan([1.0, 1.5, 2.0], 11))
    + one("CActionCollection", 0, mrpt_step(0.25, 12))
)


@pytest.mark.parametrize("content", [RAWLOG, gzip.compress(RAWLOG)], ids=["plain", "gzip"])
def test_rawlog(tmp_path: Path, content: bytes) -> None:
    """Increments of the odometry add up; beams without a return are none."""
    (tmp_path / "made.rawlog").write_bytes(content)

    done = convert(f"rawlog:{tmp_path / 'made.rawlog'}", tmp_path / "out.mcap")

    scans = decoded(done, "/scan", LaserScan2D)
    assert [scan.stamp_ns for scan in scans] == [10 * 10**9, 11 * 10**9]
    np.testing.assert_array_equal(scans[0].ranges_m, np.array([1.0, np.nan, 2.0], np.float32))
    assert scans[0].angle_min_rad == pytest.approx(-np.pi / 2)
    assert scans[0].angle_step_rad == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(
        [w.T_odom_base.t[0] for w in decoded(done, "/odom", WheelOdometry)], [0.5, 0.75]
    )
    place = decoded(done, "/tf_static", TransformBatch)[0]
    np.testing.assert_allclose(place.T_parent_child[0, :3, 3], [0.5, 0, 0.3])
    assert done.notices == ()


def test_rawlog_stops_at_what_it_does_not_know(tmp_path: Path) -> None:
    """What was read before is kept, and the classes that are not known are counted."""
    unknown = mrpt("CObservationImage", 4, b"pixels")
    (tmp_path / "made.rawlog").write_bytes(RAWLOG + one("CSensoryFrame", 2, unknown) + unknown)

    done = convert(f"rawlog:{tmp_path / 'made.rawlog'}", tmp_path / "out.mcap")

    assert len(decoded(done, "/scan", LaserScan2D)) == 2
    (notice,) = done.notices
    assert "an object of class 'CObservationImage'" in notice
    assert notice.endswith("classes that are not known here: 2 CObservationImage")


def test_rawlog_that_is_cut_is_read_up_to_the_cut(tmp_path: Path) -> None:
    (tmp_path / "made.rawlog").write_bytes(RAWLOG[:-200])

    done = convert(f"rawlog:{tmp_path / 'made.rawlog'}", tmp_path / "out.mcap")

    assert len(decoded(done, "/scan", LaserScan2D)) >= 1
    assert "too early" in done.notices[0]


def test_corrected_poses_of_a_laser_log(tmp_path: Path) -> None:
    (tmp_path / "made_gt.txt").write_text("# header\n7 1.5 1 2 0.5\n9 2.000000001 3 4 -0.5\n")

    lines, trajectory = read_corrected(tmp_path / "made_gt.txt")

    assert lines.tolist() == [7, 9]
    assert trajectory.stamps_ns.tolist() == [1_500_000_000, 2_000_000_001]
    np.testing.assert_allclose(SE3(trajectory.poses[1]).log()[2], -0.5)
    np.testing.assert_allclose(trajectory.poses[1, :3, 3], [3, 4, 0])


@pytest.mark.slow
def test_real_faculty_log_is_whole(tmp_path: Path) -> None:
    folder = shared("faculty_laser2d")
    done = convert(f"rawlog:{next(folder.glob('*.rawlog'))}", tmp_path / "out.mcap")

    scans = decoded(done, "/scan", LaserScan2D)
    assert (len(scans), done.notices) == (225, ())
    assert {len(scan.ranges_m) for scan in scans} == {361}
    wheels = decoded(done, "/odom", WheelOdometry)
    way_m = np.linalg.norm(np.diff([w.T_odom_base.t for w in wheels], axis=0), axis=1).sum()
    assert 50 < way_m < 80
