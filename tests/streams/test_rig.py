"""Sensor sets: maplab's files, selection by id, places over time, offsets."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapstream.streams.calibration import CameraCalibration, RangeImageCalibration
from mapstream.streams.channel import Channel, Limits, Receiver
from mapstream.streams.errors import ConfigError, TransformError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import GnssFix, ImuBatch, TransformBatch
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.rig_document import rig_document
from mapstream.streams.rig_file import load_rig, write_rig
from mapstream.streams.sensors import (
    CameraRigSensor,
    CameraSensor,
    FeatureSensor,
    ImuSensor,
    Sensor,
    SensorKind,
)
from mapstream.streams.shift import shifted
from mapstream.streams.sync import anchored, cut_imu, window
from tests.streams.scripts import Tick

IMU, IMU_2, LIDAR, RIG, CAM_0, CAM_1, CAM_2 = (f"{i:032x}" for i in range(1, 8))
ODOMETRY, WHEEL, ABSOLUTE, GPS, FEATURES, LOOPS = (f"{i:032x}" for i in range(8, 14))
IDENTITY = "{rows: 4, cols: 4, data: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"
COVARIANCE = """
      rows: 6
      cols: 6
      data: [[1,0,0,0,0,0],[0,2,0,0,0,0],[0,0,3,0,0,0],[0,0,0,4,0,0],[0,0,0,0,5,0],[0,0,0,0,0,6]]"""
FILE = f"""\
sensors:
  - id: {IMU}
    sensor_type: IMU
    description: "first"
    topic: /imu0
    frame: imu_link
    sigmas:
      acc_noise_density: 4e-3
      acc_bias_random_walk_noise_density: 3e-3
      gyro_noise_density: 1e-4
      gyro_bias_random_walk_noise_density: 2e-4
    saturation_accel_max_mps2: 150
    saturation_gyro_max_radps: 7.5
    gravity_magnitude_mps2: 9.81
  - {{id: {IMU_2}, sensor_type: IMU, topic: /imu1, time_offset_ns: -20000000}}
  - {{id: {LIDAR}, sensor_type: LIDAR, topic: /points}}
  - id: {RIG}
    sensor_type: NCAMERA
    topic: ""
    cameras:
      - camera:
          id: {CAM_0}
          sensor_type: CAMERA
          topic: /cam0
          line-delay-nanoseconds: 120
          image_height: 480
          image_width: 752
          type: pinhole
          intrinsics: {{cols: 1, rows: 4, data: [458.0, 457.0, 367.0, 248.0]}}
          distortion:
            type: radial-tangential
            parameters: {{cols: 1, rows: 4, data: [-0.28, 0.07, 0.0002, 0.00002]}}
        T_B_C: {{cols: 4, rows: 4, data: [1,0,0,0.1, 0,1,0,0, 0,0,1,0, 0,0,0,1]}}
      - camera:
          id: {CAM_1}
          image_height: 480
          image_width: 640
          type: unified-projection
          intrinsics: {{cols: 1, rows: 5, data: [0.9, 300, 301, 320, 240]}}
          distortion: {{type: fisheye, parameters: {{cols: 1, rows: 1, data: [0.93]}}}}
        T_B_C: {IDENTITY}
      - camera:
          id: {CAM_2}
          sensor_type: CAMERA
          image_height: 64
          image_width: 1024
          type: camera-3d-lidar
          intrinsics: {{cols: 1, rows: 4, data: [0.006, 0.009, 0.29, 0.0]}}
        T_B_C: {IDENTITY}
  - id: {ODOMETRY}
    sensor_type: ODOMETRY_6DOF
    T_St_Stp1_fixed_covariance: {COVARIANCE}
  - {{id: {WHEEL}, sensor_type: WHEEL_ODOMETRY}}
  - id: {ABSOLUTE}
    sensor_type: ABSOLUTE_6DOF
    T_G_S_fixed_covariance: {COVARIANCE}
  - {{id: {GPS}, sensor_type: GPS_WGS}}
  - {{id: {FEATURES}, sensor_type: EXTERNAL_FEATURES, target_sensor: {CAM_0}, feature_type: SuperPoint}}
  - id: {LOOPS}
    sensor_type: LOOP_CLOSURE
    T_A_B_fixed_covariance: {COVARIANCE}
extrinsics:
  - {{sensor_id: {IMU}, base_sensor_id: {IMU}, T_B_S: {IDENTITY}}}
  - sensor_id: {LIDAR}
    base_sensor_id: {IMU}
    T_B_S:
      rows: 4
      cols: 4
      data:
        - [0, -1, 0, 0.5]
        - [1, 0, 0, 0]
        - [0, 0, 1, 0.2]
        - [0, 0, 0, 1]
  - {{sensor_id: {RIG}, base_sensor_id: {LIDAR}, T_B_S: {IDENTITY}}}
"""


def _load(tmp_path: Path, text: str = FILE) -> Rig:
    path = tmp_path / "sensors.yaml"
    path.write_text(text)
    return load_rig(path)


def test_A18_a_maplab_file_loads_with_all_its_kinds(tmp_path: Path) -> None:
    rig = _load(tmp_path)

    imu = rig.sensor(IMU)
    assert isinstance(imu, ImuSensor)
    assert imu.noise is not None
    assert (imu.noise.accel_density, imu.noise.gyro_random_walk) == (4e-3, 2e-4)
    assert (imu.max_accel_mps2, imu.max_gyro_radps, imu.gravity_mps2) == (150, 7.5, 9.81)
    cameras = rig.sensor(RIG)
    assert isinstance(cameras, CameraRigSensor)
    pinhole, unified, lidar = (mount.camera.calibration for mount in cameras.mounts)
    assert isinstance(pinhole, CameraCalibration)
    assert isinstance(unified, CameraCalibration)
    assert (pinhole.model, pinhole.distortion, pinhole.line_delay_ns) == ("pinhole", "radtan", 120)
    assert (unified.model, unified.xi, unified.distortion) == ("unified", 0.9, "fov")
    np.testing.assert_array_equal(unified.focal_px, [300, 301])
    assert isinstance(lidar, RangeImageCalibration)
    assert lidar.vertical_center_rad == 0.29
    features = rig.sensor(FEATURES)
    assert isinstance(features, FeatureSensor)
    assert (features.target_sensor_id, features.feature_type) == (CAM_0, "SuperPoint")
    assert rig.sensor_of_topic("/points") is rig.sensor(LIDAR)
    assert rig.sensor_of_topic("/nothing") is None


def test_A18_covariances_have_rotation_first(tmp_path: Path) -> None:
    rig = _load(tmp_path)

    for sensor_id in (ODOMETRY, ABSOLUTE, LOOPS):
        covariance = rig.sensor(sensor_id).covariance
        assert covariance is not None
        np.testing.assert_array_equal(np.diag(covariance), [4, 5, 6, 1, 2, 3])


def test_A18_a_written_file_reloads_equal(tmp_path: Path) -> None:
    rig = _load(tmp_path)
    again = tmp_path / "again.yaml"

    write_rig(rig, again)

    assert rig_document(load_rig(again)) == rig_document(rig)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_A18_places_compose_along_the_tree(tmp_path: Path) -> None:
    rig = _load(tmp_path)

    assert rig.base_frame == "imu_link"
    np.testing.assert_allclose(rig.T_base_sensor(IMU, 0).matrix, np.eye(4))
    np.testing.assert_allclose(rig.T_base_sensor(LIDAR, 0) @ np.array([1.0, 0, 0]), [0.5, 1, 0.2])
    np.testing.assert_allclose(rig.T_base_sensor(CAM_0, 0).t, [0.5, 0.1, 0.2])
    with pytest.raises(TransformError, match=f"no frame '{GPS}'"):
        rig.T_base_sensor(GPS, 0)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("sensor_type: LIDAR", "sensor_type: LIDER", 16, "'LIDER' is none of IMU, LIDAR"),
        (f"id: {IMU_2}", "id: abc", 15, "has 32 hex digits in lower case, not 'abc'"),
        (f"id: {LIDAR}, sensor_type", "sensor_type", 16, r"sensors\[2\].id: is missing"),
        (
            "acc_noise_density: 4e-3",
            "acc_noise_density: -1",
            7,
            "accel_density is positive, not -1",
        ),
        ("gravity_magnitude_mps2: 9.81", "gravity_magnitude_mps2: no", 14, "number, got 'no'"),
        ("[0, -1, 0, 0.5]", "[0, -1, 0]", 75, "T_B_S: expected"),
        ("[0, -1, 0, 0.5]", "[0, 2, 0, 0.5]", 75, "T_B_S: not a rotation"),
        ("image_width: 752", "image_width: 0.5", 27, "image_width: expected an integer, got '0.5'"),
        ("458.0, 457.0", "458.0", 29, "intrinsics: .*center_px: expected shape"),
        ("radial-tangential", "radial", 31, "distortion.type: 'radial' is none of none, radial-"),
        ("-0.28, ", "", 29, "radtan has 4 or 5 parameters, not 3"),
        ("[1,0,0,0,0,0]", "[-1,0,0,0,0,0]", 50, "symmetric and positive definite"),
        ("  - id:", "  - id: 1\n    id:", 2, "id: is here twice, also in line 3"),
        ("topic: /imu0", "topic: [/imu0]", 5, "topic: expected a text"),
    ],
)
def test_A18_a_mistake_is_named_with_file_line_and_key(
    tmp_path: Path, old: str, new: str, line: int, message: str
) -> None:
    assert old in FILE

    with pytest.raises(ConfigError, match=f"sensors.yaml:{line}: .*{message}"):
        _load(tmp_path, FILE.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (f"base_sensor_id: {LIDAR}", f"base_sensor_id: {'f' * 32}", "no sensor has the id 'ffff"),
        (f"base_sensor_id: {LIDAR}", f"base_sensor_id: {GPS}", "on more than one base: "),
        (f"id: {IMU_2}", f"id: {IMU}", f"two sensors have the id {IMU}"),
        (f"target_sensor: {CAM_0}", f"target_sensor: {'e' * 32}", "no sensor has the id 'eeee"),
        (FILE, "[]", "expected keys and values at the top"),
    ],
)
def test_A18_parts_that_do_not_fit_are_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=f"sensors.yaml: .*{message}"):
        _load(tmp_path, FILE.replace(old, new))


def test_A18_an_id_of_digits_is_no_number(tmp_path: Path) -> None:
    text = FILE.replace(WHEEL, "1" * 8 + "e" + "2" * 23)

    write_rig(_load(tmp_path, text), tmp_path / "again.yaml")

    assert load_rig(tmp_path / "again.yaml").select("wheel").id == "1" * 8 + "e" + "2" * 23


def test_A18_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_rig(tmp_path / "none.yaml")


def test_A18_keys_that_mean_nothing_are_named_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _load(tmp_path, FILE.replace("topic: /imu0", "topic: /imu0\n    hardware_id: imu0"))

    (record,) = caplog.records
    assert "sensors.yaml:6: sensors[0].hardware_id means nothing here" in record.getMessage()


def test_A17_the_selected_imu_is_used_and_the_other_ignored_with_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = _load(tmp_path)

    with caplog.at_level(logging.INFO):
        assert rig.select("imu", IMU_2) is rig.sensor(IMU_2)

    assert [r.getMessage() for r in caplog.records] == [f"imu {IMU} (/imu0) is ignored"]
    assert rig.select("lidar") is rig.sensor(LIDAR)  # the only one needs no selection


@pytest.mark.parametrize(
    ("kind", "sensor_id", "message"),
    [
        ("imu", None, f"2 sensors of kind imu, say which by its id; there are: {IMU}"),
        ("imu", LIDAR, f"2 sensors of kind imu, none has the id {LIDAR}; there are: {IMU}"),
        ("gps_utm", None, "0 sensors of kind gps_utm, say which by its id; there are: none"),
    ],
)
def test_A17_a_missing_or_wrong_selection_is_an_error(
    tmp_path: Path, kind: SensorKind, sensor_id: str | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        _load(tmp_path).select(kind, sensor_id)


def test_A19_a_place_that_moves_is_asked_at_each_stamp() -> None:
    imu, camera = ImuSensor(id=IMU, frame="base"), Sensor(id=CAM_0, kind="lidar", frame="head")
    rig = Rig([imu, camera], base_frame="base")
    pan: Callable[[int], SE3] = lambda stamp_ns: SE3.exp([0, 0, stamp_ns / 10, 0, 0, 1])  # noqa: E731

    rig.transforms.add_function("base", "head", pan)

    for stamp_ns in range(5):
        np.testing.assert_array_equal(
            rig.T_base_sensor(CAM_0, stamp_ns).matrix, pan(stamp_ns).matrix
        )
    np.testing.assert_array_equal(rig.T_base_sensor("head", 3).matrix, pan(3).matrix)


def test_A19_tf_fills_what_the_file_leaves_open_and_no_more() -> None:
    imu = ImuSensor(id=IMU, frame="imu_link")
    lidar = Sensor(id=LIDAR, kind="lidar", frame="lidar_link")
    camera = Sensor(id=CAM_0, kind="lidar", frame="camera_link")
    place = Extrinsics(sensor_id=LIDAR, base_sensor_id=IMU, T_base_sensor=SE3.exp([0] * 5 + [1]))
    rig = Rig([imu, lidar, camera], [place])
    batch = TransformBatch(
        stamps_ns=np.zeros(2, np.int64),
        parents=("mast", "lidar_link"),
        children=("lidar_link", "camera_link"),
        T_parent_child=np.stack([SE3.exp([0] * 5 + [9]).matrix, SE3.exp([0] * 5 + [2]).matrix]),
        is_static=True,
    )

    rig.add_transforms(batch)

    np.testing.assert_allclose(rig.T_base_sensor(LIDAR, 0).t, [0, 0, 1])
    np.testing.assert_allclose(rig.T_base_sensor("camera_link", 0).t, [0, 0, 3])


def test_sensors_refuse_what_cannot_be() -> None:
    with pytest.raises(ValueError, match="max_gyro_radps is positive, not 0"):
        ImuSensor(id=IMU, max_gyro_radps=0.0)
    with pytest.raises(ValueError, match="of kind lidar has no fixed covariance"):
        Sensor(id=LIDAR, kind="lidar", covariance=np.eye(6))


def test_a_camera_mount_must_hold_a_camera(tmp_path: Path) -> None:
    text = FILE.replace(
        f"id: {CAM_0}\n          sensor_type: CAMERA",
        f"id: {CAM_0}\n          sensor_type: LIDAR",
        1,
    )

    with pytest.raises(ConfigError, match=f"expected a CAMERA, got the lidar {CAM_0}"):
        _load(tmp_path, text)


def test_a_camera_may_stand_alone() -> None:
    calibration = CameraCalibration(
        width_px=4,
        height_px=3,
        focal_px=np.ones(2),
        center_px=np.ones(2),
        distortion_parameters=np.zeros(0),
    )
    rig = Rig([CameraSensor(id=CAM_0, calibration=calibration)])

    assert rig.base_frame == "base"
    assert rig.select("camera").id == CAM_0


def _imu_batches(shift_ns: int) -> list[ImuBatch]:
    rng = np.random.default_rng(0)
    batches = []
    for i in range(20):
        stamps_ns = np.arange(10 * i, 10 * i + 10) * 5_000_000
        gyro, accel = rng.normal(size=(2, 10, 3))
        batches.append(ImuBatch(stamps_ns=stamps_ns + shift_ns, gyro_radps=gyro, accel_mps2=accel))
    return batches


@pytest.mark.anyio
async def test_A21_an_imu_shifted_by_20_ms_with_the_matching_offset_gives_the_same() -> None:
    rig = Rig([ImuSensor(id=IMU_2, topic="/imu", time_offset_ns=-20_000_000)])
    sensor = rig.sensor_of_topic("/imu")
    assert sensor is not None

    async def windows(batches: list[ImuBatch]) -> list[ImuBatch]:
        imu: Channel[ImuBatch] = Channel(limits=Limits(capacity=100))
        scans: Channel[Tick] = Channel(limits=Limits(capacity=100))
        for batch in batches:
            await imu.put(batch)
        for i in range(1, 9):
            await scans.put(Tick(i * 100_000_000))
        imu.close()
        scans.close()
        join = anchored(Receiver(scans), window(Receiver(imu), 100_000_000, cut=cut_imu))
        return [batch async for _, found in join for batch in found]

    expected = await windows(_imu_batches(0))
    corrected = await windows([shifted(b, sensor.time_offset_ns) for b in _imu_batches(20_000_000)])

    assert len(corrected) == len(expected) > 8
    for one, other in zip(corrected, expected, strict=True):
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_array_equal(one.gyro_radps, other.gyro_radps)


def test_A21_every_message_can_be_shifted() -> None:
    fix = GnssFix(stamp_ns=5, latitude_deg=1.0, longitude_deg=2.0, altitude_m=3.0)

    assert shifted(fix, 0) is fix
    assert shifted(fix, -7).stamp_ns == -2
