"""What is found of cameras: their places, lenses and clocks; and rows of rolling shutters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.fixing import Fixable
from mapstream.operators.estimation.vision.calibration import CalibrateConfig, calibrate
from mapstream.operators.landmarks.create import create_landmarks, retriangulate
from mapstream.recordings.maps.cameras import cameras_of, with_cameras
from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from tests.operators.estimation.vision.test_bundle import GATE, rms
from tests.operators.vision_worlds import PINHOLE, World, position_errors_m, stereo

WRONG = SE3.exp([*np.deg2rad([0.3, -0.4, 0.0]), 0.006, -0.008, 0.0])  # 0.5 degrees, 1 cm


def with_imu_and_cameras(world: World) -> Map:
    map_ = world.with_imu(world.map())
    return world.with_odometry(map_, 0.002, 0.005)


def misplaced(map_: Map) -> Map:
    """The map whose left camera is not where it is said to be, with landmarks as it sees them."""
    camera = cameras_of(map_, 0)["left"]
    moved = replace(camera, T_base_sensor=camera.T_base_sensor @ WRONG)
    return with_cameras(map_, 0, {"left": moved})


def test_K11_a_misplaced_camera_is_found() -> None:
    """1 cm and 0.5 degrees off: to 2 mm and 0.1 degrees, beside a camera that is where it is said to be."""
    world = World(noise_px=0.3)
    map_ = create_landmarks(misplaced(with_imu_and_cameras(world)), GATE)[0]

    result, _ = optimize_map(
        map_, OptimizeConfig(refine=("extrinsics",), refined_cameras=("left",))
    )

    found = cameras_of(result, 0)
    error = world.cameras["left"].T_base_sensor.inverse() @ found["left"].T_base_sensor
    assert np.linalg.norm(error.t) < 0.002
    assert np.rad2deg(error.angle_rad) < 0.1
    right = cameras_of(map_, 0)["right"]
    assert (found["right"].T_base_sensor.matrix == right.T_base_sensor.matrix).all()


@pytest.mark.slow
def test_U18_the_report_says_what_changed_and_what_that_explains() -> None:
    """Keypoints fit to their noise after, and not before; the error is within three standard deviations."""
    world = World(noise_px=0.3)
    map_ = create_landmarks(misplaced(with_imu_and_cameras(world)), GATE)[0]

    result, report = calibrate(map_, CalibrateConfig(cameras=("left",)))

    (found,) = report.cameras
    error = world.cameras["left"].T_base_sensor.inverse() @ cameras_of(result, 0)["left"].T_base_sensor  # fmt: skip
    assert found.rms_before_px > 3 * found.rms_after_px
    assert abs(found.rms_after_px - 0.3 * np.sqrt(2)) < 0.05
    assert abs(found.moved_m - 0.010) < 0.002
    assert np.linalg.norm(error.t) < 3 * found.sigma_m < 0.006
    assert len(list(report.lines())) == 2


@pytest.mark.slow
def test_U18_what_the_motion_does_not_show_is_refused() -> None:
    """A rig that rolls and pitches little does not show how high above the base it sits."""
    world = World(noise_px=0.3)
    map_ = create_landmarks(with_imu_and_cameras(world), GATE)[0]

    with pytest.raises(EstimationError, match=r"its position stays uncertain by .* record turns"):
        calibrate(map_)
    _, report = calibrate(with_imu_and_cameras(world))
    assert "no camera has seen a landmark" in next(report.lines())


@pytest.mark.slow
def test_K11_F11_a_lens_is_found_and_stays_if_it_is_fixed() -> None:
    """1 % of focal length and 3 px of the centre; held, it keeps its bits while the place of the camera moves."""
    lens = replace(PINHOLE, distortion="radtan", distortion_parameters=np.array([-0.1, 0.02, 0, 0]))
    world = World(cameras=stereo(lens), noise_px=0.2)
    map_ = with_imu_and_cameras(world)
    wrong = replace(
        lens,
        frame="left",
        focal_px=lens.focal_px * 1.01,
        center_px=lens.center_px + 3,
        distortion_parameters=lens.distortion_parameters + np.array([0.01, 0, 0, 0]),
    )
    camera = cameras_of(map_, 0)["left"]
    map_ = with_cameras(map_, 0, {"left": replace(camera, calibration=wrong)})
    map_ = create_landmarks(map_, GATE)[0]

    result, _ = optimize_map(map_, OptimizeConfig(refine=("intrinsics",)))
    held, _ = optimize_map(map_, OptimizeConfig(refine=("intrinsics", "extrinsics"), fix=("intrinsics",)))  # fmt: skip

    found = cameras_of(result, 0)["left"].calibration
    np.testing.assert_allclose(found.focal_px, lens.focal_px, atol=0.5)
    np.testing.assert_allclose(found.center_px, lens.center_px, atol=0.5)
    kept = cameras_of(held, 0)["left"]
    assert (kept.calibration.focal_px == wrong.focal_px).all()
    assert (kept.calibration.distortion_parameters == wrong.distortion_parameters).all()
    assert (kept.T_base_sensor.matrix != camera.T_base_sensor.matrix).any()


@pytest.mark.slow
def test_F11_halves_of_a_cameras_place_stay() -> None:
    """Bit for bit, while the other half moves."""
    world = World(noise_px=0.3, num_points=60)
    map_ = create_landmarks(misplaced(with_imu_and_cameras(world)), GATE)[0]
    before = cameras_of(map_, 0)["left"].T_base_sensor

    def placed(*fix: Fixable) -> SE3:
        config = OptimizeConfig(refine=("extrinsics",), fix=fix)
        return cameras_of(optimize_map(map_, config)[0], 0)["left"].T_base_sensor

    turned, shifted, still = placed("extrinsics_translation"), placed("extrinsics_rotation"), placed("extrinsics")  # fmt: skip

    assert (turned.t == before.t).all()
    assert (turned.R != before.R).any()
    np.testing.assert_allclose(shifted.R, before.R, atol=1e-15)
    assert (shifted.t != before.t).any()
    assert (still.matrix == before.matrix).all()


def test_F11_landmarks_stay_where_they_are() -> None:
    """While poses move."""
    world = World(noise_px=0.3, num_points=60)
    map_ = create_landmarks(with_imu_and_cameras(world), GATE)[0]

    result, _ = optimize_map(map_, OptimizeConfig(fix=("landmarks",)))

    was, now = (m.T_map_landmark(np.arange(len(m.landmarks)))[:, :3, 3] for m in (map_, result))
    np.testing.assert_allclose(now, was, atol=1e-9)
    assert (result.vertices.T_mission_base != map_.vertices.T_mission_base).any()


def test_K12_a_late_clock_is_found() -> None:
    """Images 20 ms later than their stamps: to 1 ms, and observations have the right times after."""
    world = World(noise_px=0.3, num_vertices=30, late_s=0.020)
    map_ = create_landmarks(with_imu_and_cameras(world), GATE)[0]

    result, _ = optimize_map(map_, OptimizeConfig(refine=("time_offset",)))

    offset_ms = result.observations.offset_ns / 1e6
    assert np.abs(offset_ms - 20).max() < 1


@pytest.mark.slow
def test_A22_poses_are_better_if_rows_have_times_of_their_own() -> None:
    """20 ms from the first row to the last."""
    rolling = replace(PINHOLE, line_delay_ns=41_667)
    world = World(cameras=stereo(rolling), noise_px=0.2, num_points=80)
    map_ = with_imu_and_cameras(world)
    still = {name: replace(c, calibration=replace(c.calibration, line_delay_ns=0)) for name, c in world.cameras.items()}  # fmt: skip

    errors_m = []
    for each in (map_, with_cameras(map_, 0, still)):
        result, _ = optimize_map(create_landmarks(each, GATE)[0])
        result, _ = optimize_map(retriangulate(result, GATE)[0])
        errors_m.append(rms(position_errors_m(world, result)))

    assert errors_m[0] < 0.5 * errors_m[1]
