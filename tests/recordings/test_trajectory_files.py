"""Trajectory files: exact round trips, and errors that name the line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.trajectory_files import (
    read_euroc,
    read_kitti,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import se3_exp
from mapstream.streams.trajectory import Trajectory
from tests.data import shared

trajectories = st.builds(
    lambda start, steps, seed: Trajectory(
        stamps_ns=start + np.cumsum(steps),
        poses=se3_exp(np.random.default_rng(seed).uniform(-3, 3, (len(steps), 6))),
    ),
    st.integers(0, 4 * 10**18),
    st.lists(st.integers(1, 10**12), max_size=5).map(lambda steps: np.array(steps, dtype=np.int64)),
    st.integers(0, 1000),
)


@pytest.mark.parametrize(
    ("write", "read"), [(write_tum, read_tum), (write_euroc, read_euroc)], ids=["tum", "euroc"]
)
@given(trajectory=trajectories)
def test_S3_M12_stamped_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    write: Callable[[Path, Trajectory], None],
    read: Callable[[Path], Trajectory],
    trajectory: Trajectory,
) -> None:
    """Poses come back to 1e-9 and stamps to the nanosecond."""
    path = tmp_path_factory.mktemp("t") / "poses.txt"

    write(path, trajectory)
    back = read(path)

    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(back.poses, trajectory.poses, atol=1e-9)


@given(trajectory=trajectories)
def test_S3_kitti_round_trip(
    tmp_path_factory: pytest.TempPathFactory, trajectory: Trajectory
) -> None:
    """Poses come back to 1e-9; the stamps from a file of times, nominal ones without it."""
    folder = tmp_path_factory.mktemp("t")
    times = "".join(f"{ns // 10**9}.{ns % 10**9:09d}\n" for ns in trajectory.stamps_ns.tolist())
    (folder / "times.txt").write_text(times)

    write_kitti(folder / "poses.txt", trajectory)
    nominal = read_kitti(folder / "poses.txt")
    timed = read_kitti(folder / "poses.txt", folder / "times.txt")

    np.testing.assert_allclose(timed.poses, trajectory.poses, atol=1e-9)
    np.testing.assert_array_equal(timed.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(nominal.stamps_ns, np.arange(len(trajectory)) * 100_000_000)


def test_stamps_are_not_rounded_through_floats(tmp_path: Path) -> None:
    """19 digits survive, also in scientific notation."""
    path = tmp_path / "t.txt"
    path.write_text(
        "1403715273.262142977 0 0 0 0 0 0 1\n\n# comment\n1.403715273262142978e9 0 0 0 0 0 0 2\n"
    )

    assert read_tum(path).stamps_ns.tolist() == [1403715273262142977, 1403715273262142978]


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (
            read_tum,
            "1 0 0 0 0 0 0 1\n2 0 0 0\n",
            r"t\.txt:2: expected 8 numbers, found 4: '2 0 0 0'",
        ),
        (read_tum, "1 0 0 x 0 0 0 1\n", r"t\.txt:1: expected numbers, found \['0', '0', 'x'\]"),
        (read_tum, "1 0 0 nan 0 0 0 1\n", r"t\.txt:1: expected finite numbers"),
        (read_tum, "x 0 0 0 0 0 0 1\n", r"t\.txt:1: expected a stamp, found 'x'"),
        (read_tum, "1 0 0 0 0 0 0 0\n", r"t\.txt:1: quaternion without a direction"),
        (
            read_tum,
            "2 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 0 1\n",
            r"t\.txt:3: stamps must increase, found 1000000000 after 2000000000 ns",
        ),
        (read_euroc, "#t\n1,2,3\n", r"t\.txt:2: expected 8 numbers, found 3"),
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 2 0\n", r"t\.txt:1: not a rotation"),
    ],
)
def test_errors_name_file_and_line(
    tmp_path: Path, read: Callable[[Path], Trajectory], text: str, message: str
) -> None:
    """What was expected and what was found."""
    path = tmp_path / "t.txt"
    path.write_text(text)

    with pytest.raises(RecordingError, match=message):
        read(path)


def test_an_absent_file_is_an_error(tmp_path: Path) -> None:
    """The message names the file."""
    with pytest.raises(RecordingError, match=r"absent\.tum: cannot be read"):
        read_tum(tmp_path / "absent.tum")


def test_times_and_poses_must_agree(tmp_path: Path) -> None:
    """A file of times of another length is refused, with both counts."""
    write_kitti(tmp_path / "p.txt", Trajectory(stamps_ns=np.array([1]), poses=np.eye(4)[None]))
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")

    with pytest.raises(RecordingError, match=r"as many times as poses, 1, found 2 times"):
        read_kitti(tmp_path / "p.txt", tmp_path / "times.txt")


def test_S3_reads_real_files() -> None:
    """EuRoC, TUM and KITTI files of other programs."""
    euroc = read_euroc(shared("euroc_v101_stereo_imu/gt_V1_01_easy_openvins.csv"))
    tum = read_tum(shared("euroc_v102_imu/gt_imu_V1_02_medium.tum.txt"))
    camera = read_euroc(shared("euroc_v102_imu/gt_leftcam_V102.txt"))
    kitti = read_kitti(shared("kitti00_lidar/poses_cam0_first6.txt"))

    assert int(euroc.stamps_ns[0]) == 1403715273262142976
    np.testing.assert_allclose(euroc.poses[0, :3, 3], [0.878895, 2.1834, 0.948427])
    assert len(tum) > 1000
    assert int(camera.stamps_ns[0]) == 1403715524912143104
    assert len(kitti) == 6
