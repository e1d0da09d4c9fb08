"""Registration against scenes whose places are known."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.lidar.registration import RegistrationResult, make_registration
from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.streams.errors import ConfigError, EstimationError
from mapstream.streams.geometry import SE3
from tests.operators.scenes import corridor, room, scan_at, seen_from


def _errors(
    method: str, seed: int, limit_m: float = 0.5, limit_deg: float = 10
) -> tuple[float, float]:
    """Return the error [m, deg] after starting a random 0.5 m and 10 deg off."""
    rng = np.random.default_rng(seed)
    world = room(seed, num_points=8000)
    T = SE3.exp(rng.normal(0, 0.3, 6))
    off = rng.normal(size=(2, 3))
    off *= np.array([[np.radians(limit_deg)], [limit_m]]) / np.linalg.norm(off, axis=1)[:, None]

    result = make_registration(method).align(
        seen_from(world, T, seed), world, T @ SE3.exp(off.ravel())
    )

    error = T.inverse() @ result.T_target_source
    return float(np.linalg.norm(error.t)), float(np.degrees(error.angle_rad))


@pytest.mark.slow
@pytest.mark.parametrize(("method", "within_m"), [("icp", 0.02), ("plane", 0.01), ("vgicp", 0.02)])
def test_I1_I2_each_finds_the_pose_from_half_a_metre_and_ten_degrees(
    method: str, within_m: float
) -> None:
    found = [_errors(method, seed) for seed in range(20)]

    assert sum(metres < within_m and degrees < 0.2 for metres, degrees in found) >= 19


@pytest.mark.slow
def test_I2_gicp_finds_it_within_a_centimetre() -> None:
    found = [_errors("gicp", seed) for seed in range(20)]

    assert sum(metres < 0.01 and degrees < 0.2 for metres, degrees in found) >= 19


@pytest.mark.parametrize("leaf_size_m", [None, 0.2, 0.5])
def test_I5_leaf_size_is_respected(leaf_size_m: float | None) -> None:
    """All points, or averaged ones: one per voxel, and more voxels than half a metre has."""
    world = room(1, num_points=4000)
    registration = make_registration("gicp", leaf_size_m=leaf_size_m)

    result = registration.align(world, world, SE3.identity())

    assert result.inlier_fraction > 0.99
    assert np.linalg.norm(result.T_target_source.log()) < 1e-3


def test_I5_any_point_set_registers() -> None:
    """Only the points on the boxes' and walls' edges: another point set through the same door."""
    world = room(1, num_points=6000)
    T = SE3.exp([0.02, 0.01, 0.05, 0.2, 0.1, 0.0])
    uniform = seen_from(world, T, 5)[::3]

    result = make_registration("plane", leaf_size_m=None).align(uniform, world, SE3.identity())

    assert np.linalg.norm((T.inverse() @ result.T_target_source).log()) < 0.02


@pytest.mark.parametrize("method", ["icp", "plane", "gicp", "vgicp"])
def test_I16_the_axis_of_a_corridor_gets_a_hundred_times_the_variance(method: str) -> None:
    world = corridor()

    result = make_registration(method).align(
        seen_from(world, SE3.identity(), 1), world, SE3.identity()
    )

    variances = np.diag(result.covariance)
    assert variances[3] >= 100 * max(variances[4], variances[5])
    assert np.isfinite(result.covariance).all()
    assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_the_covariance_is_of_the_size_of_the_error() -> None:
    """Over twenty pairs the errors are within a few of the standard deviations that are claimed."""
    world = room(4, num_points=8000)
    ratios = []
    for seed in range(10):
        T = SE3.exp(np.random.default_rng(seed).normal(0, 0.1, 6))
        result = make_registration("gicp").align(seen_from(world, T, seed), world, SE3.identity())
        error = (result.T_target_source.inverse() @ T).log()
        ratios.append(error / np.sqrt(np.diag(result.covariance)))

    assert 0.02 < np.sqrt(np.mean(np.square(ratios))) < 2.0


NAN = np.full((500, 3), np.nan)


@pytest.mark.parametrize("bad", [np.empty((0, 3)), np.zeros((1, 3)), NAN, np.ones((500, 3))])
@pytest.mark.parametrize("method", ["icp", "plane", "gicp", "vgicp"])
def test_clouds_that_say_nothing_are_refused(method: str, bad: np.ndarray) -> None:
    registration = make_registration(method)

    with pytest.raises(EstimationError, match="the source has"):
        registration.align(bad, room(), SE3.identity())
    with pytest.raises(EstimationError, match="the target has"):
        registration.align(room(), bad, SE3.identity())


def test_points_that_are_not_finite_are_left_out() -> None:
    world = room()
    dirty = np.concatenate([world, NAN, np.full((5, 3), np.inf)])

    result = make_registration("gicp").align(dirty, world, SE3.identity())

    assert result.inlier_fraction > 0.99


def test_clouds_that_do_not_meet_have_no_inliers() -> None:
    world = room()

    result = make_registration("gicp").align(world + 500.0, world, SE3.identity())

    assert result.inlier_fraction == 0
    assert not result.converged
    assert np.isfinite(result.covariance).all()


def test_the_same_input_gives_the_same_bytes() -> None:
    world, moved = room(), seen_from(room(), SE3.exp([0, 0, 0.05, 0.1, 0, 0]), 1)

    poses = [make_registration("gicp").align(moved, world, SE3.identity()) for _ in range(2)]

    assert poses[0].T_target_source.matrix.tobytes() == poses[1].T_target_source.matrix.tobytes()


class Centroids:
    """A registration of one's own: the shift between the middles of the two sets."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    def align(self, source: np.ndarray, target: np.ndarray, T_guess: SE3) -> RegistrationResult:
        shift = self.gain * (target.mean(axis=0) - source.mean(axis=0))
        return RegistrationResult(
            T_target_source=SE3.from_rotation(np.eye(3), shift),
            covariance=np.eye(6),
            inlier_fraction=1.0,
            rmse_m=0.0,
            converged=True,
        )


@pytest.fixture
def installed_centroids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install an entry point as a package would."""
    info = tmp_path / "centroids-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: centroids\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[mapstream.registrations]\ncentroids = tests.operators.test_registration:Centroids\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])


@pytest.mark.usefixtures("installed_centroids")
def test_I3_a_registration_of_ones_own_is_used_by_its_name() -> None:
    registration = make_registration("centroids", {"gain": 1.0}, leaf_size_m=0.5)

    result = registration.align(np.zeros((3, 3)), np.ones((3, 3)), SE3.identity())

    np.testing.assert_allclose(result.T_target_source.t, [1, 1, 1])


@pytest.mark.usefixtures("installed_centroids")
def test_I3_the_odometry_takes_it_by_one_word_of_its_config() -> None:
    config = GicpOdometryConfig(
        registration="centroids",
        registration_options={"gain": 1.0},
        voxel_size_m=1e-3,
        min_range_m=0,
    )
    operator = GicpOdometry(config)
    world = room()
    operator.register(scan_at(world, 10**9))

    odometry, _ = operator.register(scan_at(world - [0.2, 0.0, 0.0], 2 * 10**9))

    np.testing.assert_allclose(odometry.T_odom_base.t, [0.2, 0, 0], atol=0.01)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"unknown registration 'gipc'; known: .*gicp"):
        make_registration("gipc")
