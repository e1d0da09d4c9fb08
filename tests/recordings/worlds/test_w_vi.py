"""World W-VI: repeatable, true to its own truth, and with something to see everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.motion import GRAVITY_MPS2
from mapstream.recordings.worlds.satellites import ORIGIN_LLA, enu_to_lla
from mapstream.recordings.worlds.simulation import Simulation
from mapstream.recordings.worlds.vi_rig import T_BASE_CAMERA, T_BASE_IMU
from mapstream.recordings.worlds.w_vi import START_NS, WViConfig, w_vi
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import invert, so3_exp, so3_log
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import EncodedImage, GnssFix, ImuBatch, TransformBatch
from mapstream.streams.sensors import CameraSensor
from mapstream.streams.trajectory import Trajectory

SMALL: dict[str, Any] = {
    "camera": {"width_px": 160, "height_px": 120, "rate_hz": 4.0},
    "flight": {"duration_s": 1.0, "start": "moving"},
    "texel_m": 0.04,
}


def small(**changes: Any) -> Simulation:  # noqa: ANN401
    options = {
        key: value | changes.pop(key, {}) for key, value in SMALL.items() if key != "texel_m"
    }
    return w_vi(WViConfig.model_validate({"texel_m": 0.04} | options | changes), 0)


def of_type(simulation: Simulation, kind: type[Any]) -> list[Any]:
    return [r.message for r in simulation.records if isinstance(r.message, kind)]


def truth_of(messages: list[Odometry]) -> Trajectory:
    return Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in messages]),
        poses=np.stack([m.T_odom_base.matrix for m in messages]),
    )


def grey(image: EncodedImage) -> np.ndarray:
    return np.asarray(cv2.imdecode(image.data, cv2.IMREAD_GRAYSCALE))


@pytest.mark.slow
def test_R9_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    """Images are drawn by several threads, and yet come out the same."""
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (3, 3, 4), strict=True):
        simulate("w_vi", path, seed=seed, **SMALL)

    a, b, c = (path.read_bytes() for path in paths)
    assert a == b
    assert a != c


def test_the_recording_describes_its_sensors(tmp_path: Path) -> None:
    options = SMALL | {"satellites": {"rate_hz": 5.0}, "tags": 3}
    path = simulate("w_vi", tmp_path / "w.mcap", **options)

    with McapRecording(path) as recording:
        rates = {name: round(topic.frequency) for name, topic in recording.topics.items()}
    images = {f"/{name}/image": 5 for name in T_BASE_CAMERA}
    slow = {"/imu": 11, "/odometry": 21, "/truth": 101, "/gnss": 6, "/truth/tags": 0}
    assert set(rates) == set(images | slow)
    rig = rig_of(path)
    assert rig.base_frame == "base"
    np.testing.assert_allclose(rig.T_base_sensor("imu", 0).matrix, T_BASE_IMU.matrix)
    for name, place in T_BASE_CAMERA.items():
        np.testing.assert_allclose(rig.T_base_sensor(name, 0).matrix, place.matrix, atol=1e-12)
        sensor = rig.sensor_of_topic(f"/{name}/image")
        assert isinstance(sensor, CameraSensor)
        assert isinstance(sensor.calibration, CameraCalibration)
        assert sensor.calibration.distortion == "radtan"


def test_A1_the_imu_follows_the_truth_and_the_biases_it_tells() -> None:
    """Integrated from the true state with the true biases taken off, a second ends within a centimetre."""
    simulation = small(
        cameras=("rear",), imu={"accel_noise_mps2_rthz": 1e-5, "gyro_noise_radps_rthz": 1e-6}
    )
    messages = [record.message for record in simulation.records]
    truth = [m for m in messages if isinstance(m, Odometry)][1:]
    truth = [m for m in truth if m.velocity_mps is not None]
    batches = [m for m in messages if isinstance(m, ImuBatch)]
    gyro, accel = (
        np.concatenate([getattr(b, name) for b in batches]) for name in ("gyro_radps", "accel_mps2")
    )
    first, last = truth[0], truth[-1]
    assert first.gyro_bias_radps is not None
    assert first.accel_bias_mps2 is not None
    assert first.velocity_mps is not None
    gyro, accel = gyro - first.gyro_bias_radps, accel - first.accel_bias_mps2
    (R_base_imu, lever), dt = (T_BASE_IMU.R, T_BASE_IMU.t), 0.005
    R, p = first.T_odom_base.R @ R_base_imu, first.T_odom_base @ lever
    v = first.velocity_mps + first.T_odom_base.R @ np.cross(R_base_imu @ gyro[0], lever)
    for w, a in zip(gyro[:-1], accel[:-1], strict=True):
        force = R @ so3_exp(w * dt / 2) @ a - [0, 0, GRAVITY_MPS2]
        p, v = p + v * dt + force * dt**2 / 2, v + force * dt
        R = R @ so3_exp(w * dt)

    assert np.linalg.norm(p - last.T_odom_base @ lever) < 0.02
    assert np.linalg.norm(so3_log(R.T @ last.T_odom_base.R @ R_base_imu)) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_A13_A22_tags_are_seen_where_the_truth_puts_them(readout_s: float) -> None:
    """Within a pixel of the corners that OpenCV finds, also on a shutter that rolls while the robot turns."""
    simulation = small(
        camera={"width_px": 640, "height_px": 480, "readout_s": readout_s, "rate_hz": 2.0},
        flight={"kind": "turn", "duration_s": 4.0},
        cameras=("front_left",),
        tags=12,
        tag_size_m=0.8,
    )
    assert simulation.rig is not None
    camera = simulation.rig.camera_of_frame("front_left").calibration  # type: ignore[union-attr]
    assert isinstance(camera, CameraCalibration)
    messages = [record.message for record in simulation.records]
    (tags,) = (m for m in messages if isinstance(m, TransformBatch))
    truth = truth_of(
        [m for m in messages if isinstance(m, Odometry) and m.velocity_mps is not None]
    )
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    )
    half = 0.4
    corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    misses = []
    for image in (m for m in messages if isinstance(m, EncodedImage)):
        found, ids, _ = detector.detectMarkers(grey(image))
        for px, number in zip(found, np.ravel(ids) if found else [], strict=True):
            T_world_tag = tags.T_parent_child[tags.children.index(f"tag36h11:{number}")]
            row_ns = int(px[0, :, 1].mean() * camera.line_delay_ns)
            if image.stamp_ns + row_ns > truth.stamps_ns[-1]:
                continue
            T_world_camera = truth.pose_at(image.stamp_ns + row_ns) @ T_BASE_CAMERA["front_left"]
            T = invert(T_world_camera.matrix) @ T_world_tag
            misses.append(px[0] - project(camera, corners @ T[:3, :3].T + T[:3, 3])[0])
    assert len(misses) >= 6
    assert np.abs(np.mean(misses, axis=(0, 1))).max() < 0.15
    assert np.median(np.abs(misses)) < 0.6


@pytest.mark.slow
def test_every_camera_sees_corners_everywhere() -> None:
    """At least 300 FAST corners in each image of a lap, at full detail and half the width."""
    config = {
        "texel_m": 0.008,
        "camera": {"width_px": 320, "height_px": 240, "rate_hz": 0.2},
        "flight": {"duration_s": 28.0, "start": "moving"},
    }
    images = of_type(w_vi(WViConfig.model_validate(config), 0), EncodedImage)

    counts = [len(cv2.FastFeatureDetector.create(20).detect(grey(image))) for image in images]
    assert len(counts) == 5 * 6
    assert min(counts) > 300


def test_the_start_is_at_rest_or_in_motion() -> None:
    still = small(cameras=("rear",), flight={"start": "rest"})
    moving = small(cameras=("rear",))

    for simulation, low, high in ((still, 0, 1e-9), (moving, 0.3, 5)):
        speeds = [
            np.linalg.norm(m.velocity_mps)
            for m in of_type(simulation, Odometry)
            if m.velocity_mps is not None
        ]
        assert low <= speeds[0] <= high


def test_second_laps_can_be_flown_backwards() -> None:
    """At the same place of the eight the base looks the other way."""
    config = WViConfig.model_validate(
        {
            "texel_m": 0.1,
            "camera": {"rate_hz": 0.01},
            "cameras": ("rear",),
            "flight": {"turn_back": True, "duration_s": 24.0, "lap_s": 10.0},
        }
    )
    truth = truth_of([m for m in of_type(w_vi(config, 0), Odometry) if m.velocity_mps is not None])

    once, again = truth.at([START_NS + 10 * 10**9, START_NS + 20 * 10**9])

    assert np.linalg.norm(once[:3, 3] - again[:3, 3]) < 1.0
    assert once[:3, 0] @ again[:3, 0] < -0.8


def test_blind_times_are_black_or_blank() -> None:
    blindness = [
        {"start_s": 0.2, "end_s": 0.6, "cameras": ["left"]},
        {"start_s": 0.6, "end_s": 2.0, "kind": "blank"},
    ]
    images = of_type(small(cameras=("left", "rear"), camera={"blindness": blindness}), EncodedImage)

    means = {
        (i.frame, (i.stamp_ns - START_NS) // 10**6): (grey(i).mean(), grey(i).std()) for i in images
    }
    assert means["left", 250][0] < 5
    assert means["rear", 250][0] > 50
    assert means["left", 750][1] < 5
    assert means["left", 0][1] > 15


def test_long_exposures_blur_what_moves() -> None:
    """In images without loss: edges of the same view are weaker."""
    options = {"rate_hz": 1.0, "noise": 0.0, "format": "png", "width_px": 320, "height_px": 240}
    views = [
        of_type(small(cameras=("left",), camera=options | {"exposure_s": s}), EncodedImage)[0]
        for s in (0.0, 0.1)
    ]

    sharp, blurred = (cv2.Laplacian(grey(view), cv2.CV_64F).std() for view in views)

    assert {view.format for view in views} == {"png"}
    assert blurred < 0.7 * sharp


def test_K11_a_wrong_rig_and_a_wrong_clock_can_be_asked_for() -> None:
    wrong = small(
        cameras=("left", "rear"),
        camera={"rig_error_rad": 0.0087, "rig_error_m": 0.01, "time_offset_s": 0.004},
    )
    assert wrong.rig is not None

    images = of_type(wrong, EncodedImage)

    assert images[0].stamp_ns == START_NS + 4_000_000
    for name in ("left", "rear"):
        off = T_BASE_CAMERA[name].inverse() @ wrong.rig.T_base_sensor(name, 0)
        assert off.angle_rad == pytest.approx(0.0087, rel=1e-3)
        assert np.linalg.norm(off.t) == pytest.approx(0.01, rel=0.01)


def test_several_robots_fly_in_one_hall() -> None:
    first, second = (
        w_vi(
            WViConfig.model_validate(
                SMALL
                | {
                    "hall_seed": 9,
                    "cameras": ("rear",),
                    "flight": {"kind": "stand", "duration_s": 0.1},
                }
            ),
            seed,
        )
        for seed in (1, 2)
    )

    a, b = of_type(first, EncodedImage)[0], of_type(second, EncodedImage)[0]

    assert np.abs(grey(a).astype(int) - grey(b)).mean() < 5  # noise alone
    assert not np.array_equal(a.data, b.data)


def test_F9_fixes_are_on_the_ellipsoid() -> None:
    """Degrees become metres: a second of latitude at the origin is 30.88 m, 1852 m are about a minute."""
    north = enu_to_lla(np.array([[0.0, 1852.0, 0], [0, 0, 5], [0, 0, 0]]))

    assert (north[0, 0] - ORIGIN_LLA[0]) * 60 == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(north[1], [*ORIGIN_LLA[:2], ORIGIN_LLA[2] + 5], atol=1e-8)
    np.testing.assert_allclose(north[2], ORIGIN_LLA, atol=1e-8)
    fixes = of_type(small(satellites={"rate_hz": 5.0}, cameras=("rear",)), GnssFix)
    assert len(fixes) == 6
    np.testing.assert_allclose(fixes[0].covariance_enu_m2, np.eye(3) * 4e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cameras": ()}, "cameras"),
        ({"flight": {"kind": "spiral"}}, "flight.kind"),
        (
            {"camera": {"lens": "equidistant", "focal_px": 20.0, "width_px": 64, "height_px": 48}},
            "too far aside",
        ),
    ],
)
def test_what_cannot_be_simulated_is_refused(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate("w_vi", tmp_path / "w.mcap", **SMALL | options)

    assert not list(tmp_path.iterdir())
