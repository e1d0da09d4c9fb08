"""ROS messages, serialized by rosbags, decode to what went in, in both encodings."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.decoding import decoder_for, message_type_of
from mapstream.recordings.recording import Channel, RawMessage
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    ImuBatch,
    LaserScan2D,
    TransformBatch,
    WheelOdometry,
)
from tests.recordings.decoding.made_ros import (
    STAMP_NS,
    cloud,
    header,
    imu,
    make,
    pose,
    quaternion,
    raw,
    vector,
)

both = pytest.mark.parametrize("encoding", ["cdr", "ros1"])
_BINNING_AND_REGION = 2 * 4 + 4 * 4 + 1  # bytes at the end of a CameraInfo
_AT_1_2_3 = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def _decode(message: RawMessage, message_type: type[Any] | None = None) -> Any:  # noqa: ANN401
    decoder = decoder_for(message.channel, message_type)
    found = decoder(message)
    assert isinstance(found, decoder.message_type)
    return found


@both
def test_imu(encoding: str) -> None:
    batch = _decode(imu(encoding))

    assert isinstance(batch, ImuBatch)
    assert batch.stamps_ns.tolist() == [STAMP_NS]
    assert batch.gyro_radps.tolist() == [[0.1, 0.2, 0.3]]
    assert batch.accel_mps2.tolist() == [[1.0, 2.0, 9.8]]
    assert batch.frame == "imu_link"


def test_many_imu_messages_are_the_same_as_one_by_one() -> None:
    messages = [imu("cdr", k) for k in range(5)]
    decoder = decoder_for(messages[0].channel)

    together = decoder.many(messages)

    assert isinstance(together, ImuBatch)
    alone = [decoder(message) for message in messages]
    for name in ("stamps_ns", "gyro_radps", "accel_mps2"):
        expected = np.concatenate([getattr(one, name) for one in alone])
        np.testing.assert_array_equal(getattr(together, name), expected)


def test_imu_messages_that_differ_do_not_batch() -> None:
    decoder = decoder_for(imu("cdr").channel)

    with pytest.raises(DecodeError, match="different lengths"):
        decoder.many([imu("cdr"), imu("cdr", frame="the_imu_of_another")])
    with pytest.raises(DecodeError, match="different frames"):
        decoder.many([imu("cdr"), imu("cdr", frame="imu_kink")])


@both
def test_laser_scan_marks_what_was_not_seen(encoding: str) -> None:
    message = make(
        encoding,
        "sensor_msgs/LaserScan",
        header=header(encoding, "laser"),
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=0.5,
        time_increment=0.001,
        scan_time=0.1,
        range_min=0.1,
        range_max=10.0,
        ranges=np.array([1, 0.05, np.inf, np.nan, 9], np.float32),
        intensities=np.zeros(0, np.float32),
    )

    scan = _decode(raw(encoding, "sensor_msgs/LaserScan", message))

    assert isinstance(scan, LaserScan2D)
    np.testing.assert_array_equal(
        scan.ranges_m, np.array([1, np.nan, np.nan, np.nan, 9], np.float32)
    )
    assert scan.beam_period_ns == 1_000_000
    assert scan.intensity is None


@both
def test_fix_and_no_fix(encoding: str) -> None:
    def message(status: int) -> RawMessage:
        fix = make(
            encoding,
            "sensor_msgs/NavSatFix",
            header=header(encoding, "gps"),
            status=make(encoding, "sensor_msgs/NavSatStatus", status=status, service=1),
            latitude=47.5,
            longitude=8.5,
            altitude=400.0,
            position_covariance=np.diag([1.0, 2.0, 3.0]).ravel(),
            position_covariance_type=2,
        )
        return raw(encoding, "sensor_msgs/NavSatFix", fix)

    fix = _decode(message(0))

    assert isinstance(fix, GnssFix)
    assert (fix.latitude_deg, fix.longitude_deg, fix.altitude_m) == (47.5, 8.5, 400.0)
    assert fix.covariance_enu_m2 is not None
    assert np.diag(fix.covariance_enu_m2).tolist() == [1, 2, 3]
    with pytest.raises(DecodeError, match="no fix"):
        _decode(message(-1))


def _odometry(encoding: str) -> RawMessage:
    covariance = np.arange(36.0)
    twist = make(
        encoding,
        "geometry_msgs/Twist",
        linear=vector(encoding, 1.0, 0.0, 0.0),
        angular=vector(encoding, 0.0, 0.0, 0.0),
    )
    message = make(
        encoding,
        "nav_msgs/Odometry",
        header=header(encoding, "odom"),
        child_frame_id="base_link",
        pose=make(
            encoding, "geometry_msgs/PoseWithCovariance", pose=pose(encoding), covariance=covariance
        ),
        twist=make(
            encoding, "geometry_msgs/TwistWithCovariance", twist=twist, covariance=covariance
        ),
    )
    return raw(encoding, "nav_msgs/Odometry", message)


@both
def test_odometry_turns_its_velocity_into_the_odom_frame(encoding: str) -> None:
    odometry = _decode(_odometry(encoding))

    assert isinstance(odometry, Odometry)
    np.testing.assert_allclose(odometry.T_odom_base.matrix, _AT_1_2_3, atol=1e-12)
    assert odometry.velocity_mps is not None
    np.testing.assert_allclose(odometry.velocity_mps, [0, 1, 0], atol=1e-12)


def test_odometry_of_wheels_has_its_covariance_rotation_first() -> None:
    odometry = _decode(_odometry("cdr"), WheelOdometry)

    assert isinstance(odometry, WheelOdometry)
    assert odometry.covariance is not None
    assert odometry.covariance[0, 0] == 3 * 6 + 3
    assert odometry.covariance[3, 0] == 0 * 6 + 3
    with pytest.raises(DecodeError, match="decodes to Odometry, WheelOdometry, not to GnssFix"):
        decoder_for(_odometry("cdr").channel, GnssFix)


@both
def test_poses(encoding: str) -> None:
    plain = make(
        encoding, "geometry_msgs/PoseStamped", header=header(encoding), pose=pose(encoding)
    )
    covariance = make(
        encoding, "geometry_msgs/PoseWithCovariance", pose=pose(encoding), covariance=np.zeros(36)
    )
    with_covariance = make(
        encoding,
        "geometry_msgs/PoseWithCovarianceStamped",
        header=header(encoding),
        pose=covariance,
    )

    for name, message in [
        ("geometry_msgs/PoseStamped", plain),
        ("geometry_msgs/PoseWithCovarianceStamped", with_covariance),
    ]:
        found = _decode(raw(encoding, name, message))
        np.testing.assert_allclose(found.T_odom_base.matrix, _AT_1_2_3, atol=1e-12)


def test_a_pose_without_a_direction_is_refused() -> None:
    zero = make(
        "cdr",
        "geometry_msgs/Pose",
        position=vector("cdr", 1.0, 2.0, 3.0, "Point"),
        orientation=quaternion("cdr", 0.0, 0.0, 0.0, 0.0),
    )
    message = make("cdr", "geometry_msgs/PoseStamped", header=header("cdr"), pose=zero)

    with pytest.raises(DecodeError, match="not a pose"):
        _decode(raw("cdr", "geometry_msgs/PoseStamped", message))


@both
@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_transforms(encoding: str, topic: str) -> None:
    transforms = [
        make(
            encoding,
            "geometry_msgs/TransformStamped",
            header=header(encoding, "base", STAMP_NS + k),
            child_frame_id=f"/sensor{k}",
            transform=make(
                encoding,
                "geometry_msgs/Transform",
                translation=vector(encoding, 1.0, 2.0, 3.0),
                rotation=quaternion(encoding, 0.0, 0.0, 1.0, 1.0),
            ),
        )
        for k in range(3)
    ]
    message = make(encoding, "tf2_msgs/TFMessage", transforms=transforms)

    batch = _decode(raw(encoding, "tf2_msgs/TFMessage", message, topic))

    assert isinstance(batch, TransformBatch)
    assert batch.is_static is (topic == "/tf_static")
    assert batch.children == ("sensor0", "sensor1", "sensor2")
    assert batch.stamps_ns.tolist() == [STAMP_NS, STAMP_NS + 1, STAMP_NS + 2]
    np.testing.assert_allclose(batch.T_parent_child[2], _AT_1_2_3, atol=1e-12)


def _image(encoding: str, /, **fields: object) -> RawMessage:
    pixels = np.arange(2 * 8, dtype=np.uint8)
    given = {"header": header(encoding, "cam"), "height": 2, "width": 2, "encoding": "bgr8",
             "is_bigendian": 0, "step": 8, "data": pixels}  # fmt: skip
    return raw(encoding, "sensor_msgs/Image", make(encoding, "sensor_msgs/Image", **given | fields))


@both
def test_images_are_views_with_row_steps(encoding: str) -> None:
    frame = _decode(_image(encoding))

    assert isinstance(frame, CameraFrame)
    assert frame.image.tolist() == [[[0, 1, 2], [3, 4, 5]], [[8, 9, 10], [11, 12, 13]]]
    assert (frame.encoding, frame.frame) == ("bgr8", "cam")


def test_image_encodings() -> None:
    depth = _decode(_image("cdr", encoding="16UC1", step=4, data=np.arange(8, dtype=np.uint8)))
    with_alpha = _decode(_image("cdr", encoding="rgba8"))
    big = _decode(_image("cdr", encoding="mono16", step=8, is_bigendian=1))

    assert depth.image.tolist() == [[0x0100, 0x0302], [0x0504, 0x0706]]
    assert with_alpha.image.shape == (2, 2, 3)
    assert with_alpha.encoding == "rgb8"
    assert big.image.tolist() == [[0x0001, 0x0203], [0x0809, 0x0A0B]]
    with pytest.raises(DecodeError, match=r"image encoding 'bayer_rggb8'; known: mono8"):
        _decode(_image("cdr", encoding="bayer_rggb8"))
    with pytest.raises(DecodeError, match=r"9 x 2 bgr8 with rows of 8 bytes does not fit in 16"):
        _decode(_image("cdr", width=9))


@both
def test_compressed_images(encoding: str) -> None:
    def message(text: str) -> RawMessage:
        content = np.arange(20, dtype=np.uint8)
        fields = {"header": header(encoding, "cam"), "format": text, "data": content}
        made = make(encoding, "sensor_msgs/CompressedImage", **fields)
        return raw(encoding, "sensor_msgs/CompressedImage", made)

    jpeg = _decode(message("bgr8; jpeg compressed bgr8"))
    depth = _decode(message("16UC1; compressedDepth png"))

    assert isinstance(jpeg, EncodedImage)
    assert (jpeg.format, jpeg.data.tolist()) == ("jpeg", list(range(20)))
    assert (depth.format, depth.data.tolist()) == ("png", list(range(12, 20)))


def _camera_info(encoding: str, /, **fields: object) -> RawMessage:
    region = make(encoding, "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
                  do_rectify=False)  # fmt: skip
    names = ["d", "k", "r", "p"] if encoding == "cdr" else ["D", "K", "R", "P"]
    K = np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1])
    values = [np.array([0.1, 0.2, 0.3, 0.4, 0.5]), K, np.eye(3).ravel(), np.zeros(12)]
    given = {"header": header(encoding, "cam"), "height": 480, "width": 640,
             "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": region}  # fmt: skip
    message = make(
        encoding, "sensor_msgs/CameraInfo", **given | dict(zip(names, values, strict=True)) | fields
    )
    return raw(encoding, "sensor_msgs/CameraInfo", message)


@both
def test_camera_info(encoding: str) -> None:
    camera = _decode(_camera_info(encoding))

    assert isinstance(camera, CameraCalibration)
    assert (camera.width_px, camera.height_px, camera.distortion) == (640, 480, "radtan")
    assert camera.distortion_parameters.tolist() == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert camera.camera_matrix.tolist() == [[500, 0, 320], [0, 510, 240], [0, 0, 1]]


def test_camera_info_that_ends_before_binning_has_none() -> None:
    """As minimal writers have it, with a schema that says so."""
    whole = _camera_info("cdr")
    short = replace(whole, data=whole.data[:-_BINNING_AND_REGION])

    assert _decode(short).focal_px.tolist() == [500, 510]
    with pytest.raises(DecodeError, match="it ends inside a field of 8 bytes"):
        _decode(replace(whole, data=whole.data[: -_BINNING_AND_REGION + 4]))


def test_camera_info_that_says_too_little_or_too_much() -> None:
    none = _decode(_camera_info("cdr", d=np.zeros(5)))
    rational = _decode(
        _camera_info("cdr", distortion_model="rational_polynomial", d=np.arange(8.0))
    )

    assert (none.distortion, rational.distortion) == ("none", "rational_polynomial")
    with pytest.raises(DecodeError, match="not calibrated: all of K is zero"):
        _decode(_camera_info("cdr", k=np.zeros(9)))
    with pytest.raises(DecodeError, match="distortion 'odd'; known: none, plumb_bob"):
        _decode(_camera_info("cdr", distortion_model="odd"))
    with pytest.raises(DecodeError, match="binning"):
        _decode(_camera_info("cdr", binning_x=2))


@both
def test_a_wrong_length_names_schema_topic_time_and_reason(encoding: str) -> None:
    message = imu(encoding)
    message.data = message.data[:-20]
    longer = imu(encoding)
    longer.data = memoryview(bytes(longer.data) + bytes(16))

    with pytest.raises(
        DecodeError, match=rf"/imu: sensor_msgs/msg/Imu at log time {STAMP_NS} .*ends inside"
    ):
        _decode(message)
    with pytest.raises(DecodeError, match="16 bytes are left behind its last field"):
        _decode(longer)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), encoding=st.sampled_from(["cdr", "ros1"]))
def test_damaged_messages_raise_nothing_but_decode_errors(
    data: st.DataObject, encoding: str
) -> None:
    points = np.ones(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    makers: list[Callable[[str], RawMessage]] = [
        _odometry,
        _image,
        _camera_info,
        imu,
        lambda e: cloud(e, points),
    ]
    message = data.draw(st.sampled_from(makers))(encoding)
    content = bytearray(message.data)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    message.data = memoryview(bytes(content[: data.draw(st.integers(0, len(content)))]))

    with contextlib.suppress(DecodeError):
        decoder_for(message.channel)(message)


def test_other_encapsulations_are_refused() -> None:
    message = imu("cdr")
    message.data = memoryview(b"\x00\x00" + bytes(message.data[2:]))

    with pytest.raises(DecodeError, match=r"expected little-endian CDR \(0x0001\), found 0000"):
        _decode(message)


def test_unknown_schemas_and_encodings_name_the_known_ones() -> None:
    packets = Channel(
        topic="/packets", message_encoding="cdr", schema_name="velodyne_msgs/msg/VelodyneScan"
    )
    odd = Channel(topic="/odd", message_encoding="morse", schema_name="Dots")

    with pytest.raises(
        DecodeError,
        match=r"/packets: no decoder for schema 'velodyne_msgs/VelodyneScan' in cdr; known: sensor_msgs/Imu",
    ):
        decoder_for(packets)
    with pytest.raises(
        DecodeError, match=r"/odd: message encoding 'morse' is not known; known: cdr"
    ):
        decoder_for(odd)
    with pytest.raises(DecodeError, match="a channel without a schema"):
        decoder_for(Channel(topic="/none", message_encoding="cdr"))
    assert message_type_of(packets) is None
    assert message_type_of(imu("cdr").channel) is ImuBatch
