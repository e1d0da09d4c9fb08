"""LiDAR odometry against motions that are known, and against input that would abort the process."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan
from tests.data import shared
from tests.operators.scenes import drive, room, scan_at

pytestmark = pytest.mark.anyio


Maker = Callable[..., KissOdometry | GicpOdometry]


def kiss(*, voxel_size_m: float = 0.5, max_lost_scans: int = 5) -> KissOdometry:
    return KissOdometry(
        KissOdometryConfig(voxel_size_m=voxel_size_m, max_lost_scans=max_lost_scans)
    )


def gicp(*, max_lost_scans: int = 5) -> GicpOdometry:
    return GicpOdometry(GicpOdometryConfig(max_lost_scans=max_lost_scans))


MAKERS = pytest.mark.parametrize("make", [kiss, gicp])


def kitti(number: int) -> LidarScan:
    path = shared("kitti00_lidar") / f"{number:06d}.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    return scan_at(points[:, :3], 10**9 + number * 10**8)


def reference_poses(scans: list[LidarScan], voxel_size_m: float) -> list[np.ndarray]:
    """Return the poses that kiss_icp itself gives."""
    config = KISSConfig()
    config.mapping.voxel_size = voxel_size_m
    config.registration.max_num_threads = 1
    icp = KissICP(config)
    poses = []
    for scan in scans:
        times = np.empty(0) if scan.offsets_ns is None else scan.offsets_ns.astype(float)
        icp.register_frame(scan.points.astype(np.float64), times)
        poses.append(icp.last_pose)
    return poses


def timed(scans: list[LidarScan]) -> list[LidarScan]:
    """Return the scans with times over a sweep of 0.1 s."""
    rng = np.random.default_rng(0)
    return [
        scan_at(
            scan.points,
            scan.stamp_ns - 10**8,
            offsets_ns=np.sort(rng.integers(0, 10**8 + 1, len(scan.points))),
            intensity=np.ones(len(scan.points)),
        )
        for scan in scans
    ]


@pytest.mark.parametrize("with_times", [False, True])
async def test_C11_the_trajectory_is_that_of_kiss_icp(*, with_times: bool) -> None:
    scans = timed(drive()[0]) if with_times else drive()[0]

    out = await run_operator(kiss(), scans=scans)

    for odometry, pose in zip(out["odometry"], reference_poses(scans, 0.5), strict=True):
        np.testing.assert_allclose(odometry.T_odom_base.matrix, pose, atol=1e-6)


@pytest.mark.slow
async def test_C11_the_trajectory_is_that_of_kiss_icp_on_a_street() -> None:
    scans = [kitti(number) for number in range(4)]

    out = await run_operator(kiss(voxel_size_m=1.0), scans=scans)

    for odometry, pose in zip(out["odometry"], reference_poses(scans, 1.0), strict=True):
        np.testing.assert_allclose(odometry.T_odom_base.matrix, pose, atol=1e-6)
    assert 2.0 < out["odometry"][-1].T_odom_base.t[0] < 2.2  # 0.70 m a step


@MAKERS
async def test_a_steady_drive_is_recovered(make: Maker) -> None:
    scans, poses = drive()

    out = await run_operator(make(), scans=scans)

    for odometry, T in zip(out["odometry"], poses, strict=True):
        error = (T.inverse() @ odometry.T_odom_base).log()
        assert np.linalg.norm(error[3:]) < 0.05
        assert not odometry.is_lost
    assert [o.stamp_ns for o in out["odometry"]] == [s.end_ns for s in scans]
    assert [c.stamp_ns for c in out["clouds"]] == [s.end_ns for s in scans]


@MAKERS
async def test_a_sensor_that_turns_on_a_base_that_stands_gives_no_motion(make: Maker) -> None:
    """Poses and clouds are the base's, whatever the mounting is at each stamp."""
    world = room(2, num_points=20000)
    mounts = [SE3.exp([0, 0, 0.05 * k, 0.3, 0.1, 0.8]) for k in range(8)]
    scans = [
        scan_at(T.inverse() @ world, 10**9 + k * 10**8, T_base_sensor=T)
        for k, T in enumerate(mounts)
    ]

    out = await run_operator(make(), scans=scans)

    for odometry, cloud in zip(out["odometry"], out["clouds"], strict=True):
        assert np.linalg.norm(odometry.T_odom_base.log()) < 0.02
        assert np.abs(cloud.points).max() < 8.5  # the hall's half length: not the sensor's frame


@MAKERS
async def test_the_same_scans_give_the_same_bytes(make: Maker) -> None:
    scans, _ = drive(4)

    runs = [await run_operator(make(), scans=timed(scans)) for _ in range(2)]

    for a, b in zip(runs[0]["odometry"], runs[1]["odometry"], strict=True):
        assert a.T_odom_base.matrix.tobytes() == b.T_odom_base.matrix.tobytes()
    for a, b in zip(runs[0]["clouds"], runs[1]["clouds"], strict=True):
        assert a.points.tobytes() == b.points.tobytes()


def _bad_scans() -> dict[str, LidarScan]:
    points = room(0, num_points=2000).astype(np.float32)
    n = len(points)
    dirty = points.copy()
    dirty[::2] = np.nan
    dirty[1::4] = np.inf
    times = np.linspace(0, 10**8, n).astype(np.int64)
    return {
        "empty": scan_at(points[:0], 1),
        "empty with times": scan_at(points[:0], 1, offsets_ns=np.empty(0, np.int64)),
        "one point": scan_at(points[:1], 1, offsets_ns=np.zeros(1, np.int64)),
        "equal times": scan_at(points, 1, offsets_ns=np.full(n, 7)),
        "not finite": scan_at(dirty, 1, offsets_ns=times),
        "all not finite": scan_at(np.full((n, 3), np.nan), 1, offsets_ns=times),
        "all at one place": scan_at(np.ones((n, 3)), 1, offsets_ns=times),
        "far away": scan_at(points + 1e7, 1, offsets_ns=times),
        "times of minutes": scan_at(points, 1, offsets_ns=times * 1000),
    }


@MAKERS
@pytest.mark.parametrize("name", list(_bad_scans()))
async def test_bad_scans_neither_abort_nor_pass_in_silence(make: Maker, name: str) -> None:
    """First, in the middle, last: each gives a finite pose, and good scans after it are tracked."""
    bad, (good, _) = _bad_scans()[name], drive(3)
    order = [bad, good[0], bad, good[1], good[2], bad]
    scans = [
        scan_at(s.points, 10**9 + k * 10**8, offsets_ns=s.offsets_ns) for k, s in enumerate(order)
    ]
    context = Context()

    out = await run_operator(make(), run_context=context, scans=scans)

    odometry: list[Odometry] = out["odometry"]
    assert len(odometry) == len(out["clouds"]) == len(scans)
    assert all(np.isfinite(o.T_odom_base.matrix).all() for o in odometry)
    lost = [o for o in odometry if o.is_lost]
    assert len(context.activity.warnings) == len(lost)
    for each in lost:
        assert each.covariance is not None
        assert each.covariance[5, 5] > 1.0
    if name not in ("equal times", "not finite", "times of minutes", "far away"):
        assert [o.is_lost for o in odometry] == [True, False, True, False, False, True]


@MAKERS
async def test_a_jump_is_lost_with_its_stamp_and_does_not_spoil_what_follows(make: Maker) -> None:
    scans, poses = drive(8)
    elsewhere = room(99, num_points=20000) * [0.3, 0.3, 2.0] + [0, 0, 20]
    scans[5] = scan_at(elsewhere, scans[5].stamp_ns)
    context = Context()

    out = await run_operator(make(), run_context=context, scans=scans)

    assert [o.is_lost for o in out["odometry"]] == [k == 5 for k in range(8)]
    (message,) = context.activity.warnings
    assert f"scan at {scans[5].stamp_ns} ns could not be registered" in message
    error = (poses[-1].inverse() @ out["odometry"][-1].T_odom_base).log()
    assert np.linalg.norm(error[3:]) < 0.06


@MAKERS
async def test_after_a_change_of_the_world_tracking_starts_anew(make: Maker) -> None:
    scans, _ = drive(4)
    other = room(99, num_points=20000) * [0.3, 0.3, 2.0] + [0, 0, 20]
    scans += [scan_at(other, 2 * 10**9 + k * 10**8) for k in range(5)]

    out = await run_operator(make(max_lost_scans=2), scans=scans)

    assert [o.is_lost for o in out["odometry"]][4:] == [True, True, True, False, False]


async def test_gyroscope_and_constant_velocity_agree_on_a_steady_turn() -> None:
    scans, poses = drive(6)
    stamps_ns = np.arange(10**9 - 2 * 10**8, scans[-1].end_ns + 10**7, 5_000_000)
    rate = np.array([0, 0, 0.3])
    imu = [
        ImuBatch(
            stamps_ns=part,
            gyro_radps=np.tile(rate, (len(part), 1)),
            accel_mps2=np.zeros((len(part), 3)),
        )
        for part in np.array_split(stamps_ns, 13)
    ]

    out = await run_operator(gicp(), scans=scans, imu=imu)

    error = (poses[-1].inverse() @ out["odometry"][-1].T_odom_base).log()
    assert np.linalg.norm(error) < 0.05


async def test_motion_that_begins_between_two_batches_is_covered() -> None:
    """Scans end after the last sample of one batch, and before the first of the next."""
    scans, _ = drive(4)
    imu = [
        ImuBatch(
            stamps_ns=start_ns + 2_000_000 + np.arange(20) * 5_000_000,
            gyro_radps=np.tile([0, 0, 0.3], (20, 1)),
            accel_mps2=np.zeros((20, 3)),
        )
        for start_ns in range(scans[0].stamp_ns - 2 * 10**8, scans[-1].end_ns + 1, 10**8)
    ]
    context = Context()

    await run_operator(gicp(), scans=scans, imu=imu, run_context=context)

    assert not context.activity.warnings


@pytest.mark.slow
@MAKERS
async def test_indoor_at_2_hz_where_the_sensor_turns_by_23_degrees_between_scans(
    make: Maker,
) -> None:
    """Below 0.10 m of the reference at each of the 30 scans (it asks for 1.0 m)."""
    folder: Path = shared("indoor_lidar_2hz")
    rows = np.loadtxt(folder / "alidarPose.csv", delimiter=",", usecols=range(4)).reshape(-1, 4, 4)
    stamps_ns = (rows[:, 3, 3] * 1e9).astype(np.int64)
    rows[:, 3, 3] = 1
    scans = [
        scan_at(
            np.fromfile(folder / f"{k:06d}.bin", np.float32).reshape(-1, 4)[:, :3],
            int(stamps_ns[k]),
        )
        for k in range(30)
    ]

    out = await run_operator(make(), scans=scans)

    for odometry, reference in zip(out["odometry"], rows, strict=False):
        error = np.linalg.inv(rows[0]) @ reference
        assert np.linalg.norm(error[:3, 3] - odometry.T_odom_base.t) < 0.10
        assert not odometry.is_lost
