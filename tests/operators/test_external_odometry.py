"""Odometry of other programs, in the layouts that they record, makes maps by the graph file alone."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.load import parse_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.operators.odometry.odometry_adapter import OdometryAdapter, OdometryAdapterConfig
from mapstream.operators.sources.iterator import IteratorSourceConfig, iterator_source
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import Channel
from mapstream.recordings.trajectory_files import write_tum
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3, quat_xyzw_from_rotation, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.trajectory import Trajectory
from tests.recordings.decoding.made_ros import header, make, raw, vector

pytestmark = pytest.mark.anyio

START_NS, PERIOD_NS, NUM_POSES = 1_700_000_000_000_000_000, 100_000_000, 12
GYRO_BIAS, ACCEL_BIAS = [0.01, -0.02, 0.03], [0.1, 0.2, -0.3]
SPEED_MPS = 2.0
MAPPING = """
  keyframes: {use: keyframes, in: {odometry: ODOMETRY}, config: {distance_m: 0.3}}
  submaps: {use: submap_builder, in: {keyframes: keyframes.keyframes}}
  optimizer: {use: optimizer, in: {submaps: submaps.submaps}, run: inline}
  store: {use: map_store, in: {maps: optimizer.maps}, config: {path: $map}, run: inline}
"""
FROM_TOPIC = "  sensors: {use: mcap, config: {path: $source, topics: TOPICS}}" + MAPPING
FROM_FILE = "  sensors: {use: odometry_file, config: {path: $source}}" + MAPPING
ROVIO_BIASES = """
  sensors:
    use: mcap
    config: {path: $source, topics: {odometry: /rovio/odometry, biases: /rovio/imu_biases}}
  adapter: {use: odometry_adapter, in: {odometry: sensors.odometry, biases: sensors.biases}}
"""


def drive() -> Trajectory:
    """A curve at constant speed."""
    turns = np.arange(NUM_POSES)[:, None] * [0, 0, 0.05, SPEED_MPS * PERIOD_NS / 1e9, 0, 0]
    stamps_ns = START_NS + PERIOD_NS * np.arange(NUM_POSES)
    return Trajectory(stamps_ns=stamps_ns, poses=se3_exp(turns))


async def mapped(
    operators: str,
    source: Path,
    catalogue: Catalogue | None = None,
    odometry: str = "sensors.odometry",
) -> Map:
    """Run a graph of these operators; return the map that it leaves."""
    folder = source.parent / "map"
    text = f"version: 1\nname: test\nparams: {{source: {{type: path}}, map: {{type: path}}}}\noperators:\n{operators}"
    values = {"source": str(source), "map": str(folder)}
    graph = parse_graph(text.replace("ODOMETRY", odometry), params=values)
    report = await run_graph(plan(graph, catalogue or Catalogue()))
    assert report.status == "complete", report
    return load_map(folder)


def ros_odometry(
    stamp_ns: int, T: np.ndarray, *, twist_mps: float, covariance: float = 0.0
) -> bytes:
    x, y, z, w = quat_xyzw_from_rotation(T[:3, :3]).tolist()
    pose = make(
        "cdr",
        "geometry_msgs/Pose",
        position=of_three(T[:3, 3].tolist(), "Point"),
        orientation=make("cdr", "geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
    )
    none = vector("cdr", 0.0, 0.0, 0.0)
    twist = make(
        "cdr", "geometry_msgs/Twist", linear=vector("cdr", twist_mps, 0.0, 0.0), angular=none
    )
    matrix = np.eye(6).ravel() * covariance
    message = make(
        "cdr",
        "nav_msgs/Odometry",
        header=header("cdr", "world", stamp_ns),
        child_frame_id="imu",
        pose=make("cdr", "geometry_msgs/PoseWithCovariance", pose=pose, covariance=matrix),
        twist=make("cdr", "geometry_msgs/TwistWithCovariance", twist=twist, covariance=matrix),
    )
    return bytes(raw("cdr", "nav_msgs/Odometry", message).data)


def of_three(xyz: list[float], name: str = "Vector3") -> Any:  # noqa: ANN401  # made at run time
    x, y, z = xyz
    return vector("cdr", x, y, z, name)


def ros_imu(stamp_ns: int, gyro: list[float], accel: list[float]) -> bytes:
    message = make(
        "cdr",
        "sensor_msgs/Imu",
        header=header("cdr", "imu", stamp_ns),
        orientation=make("cdr", "geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=of_three(gyro),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=of_three(accel),
        linear_acceleration_covariance=np.zeros(9),
    )
    return bytes(raw("cdr", "sensor_msgs/Imu", message).data)


def recorded(
    path: Path,
    topic: str,
    schema: str,
    encode: Callable[[int, np.ndarray], bytes],
    *,
    biases_topic: str | None = None,
) -> Path:
    truth = drive()
    with McapWriter(path) as writer:
        for stamp_ns, T in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
            if biases_topic is not None:
                channel = Channel(
                    topic=biases_topic, message_encoding="cdr", schema_name="sensor_msgs/msg/Imu"
                )
                writer.write_raw(channel, ros_imu(stamp_ns, GYRO_BIAS, ACCEL_BIAS), stamp_ns)
            channel = Channel(topic=topic, message_encoding="cdr", schema_name=schema)
            writer.write_raw(channel, encode(stamp_ns, T), stamp_ns)
    return path


def with_twist(stamp_ns: int, T: np.ndarray) -> bytes:
    return ros_odometry(stamp_ns, T, twist_mps=SPEED_MPS, covariance=0.01)


def without_twist(stamp_ns: int, T: np.ndarray) -> bytes:
    return ros_odometry(stamp_ns, T, twist_mps=0.0)


def assert_is_the_drive(map_: Map) -> None:
    truth = drive()
    expected = truth.at(map_.vertices.stamp_ns)
    assert len(map_.vertices) >= 5
    assert set(map_.edges.kind) == {"odometry"}
    np.testing.assert_allclose(
        map_.vertices.T_mission_base, np.linalg.inv(truth.poses[0]) @ expected, atol=1e-6
    )


def assert_velocity_is_along_the_drive(map_: Map) -> None:
    forward = map_.vertices.T_mission_base[:, :3, 0]
    np.testing.assert_allclose(map_.vertices.velocity_mps, SPEED_MPS * forward, atol=1e-6)


async def test_A9_a_map_from_a_tum_file_alone(tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.tum", drive())

    map_ = await mapped(FROM_FILE, tmp_path / "poses.tum")

    assert_is_the_drive(map_)
    assert np.isnan(map_.vertices.velocity_mps).all()


async def test_A9_a_map_from_csv_with_velocity_alone(tmp_path: Path) -> None:
    truth = drive()
    rows = ["stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw,vx_mps,vy_mps,vz_mps"]
    for stamp_ns, T in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
        numbers = [*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3]), *(SPEED_MPS * T[:3, 0])]
        rows.append(",".join([str(stamp_ns), *(repr(float(number)) for number in numbers)]))
    (tmp_path / "poses.csv").write_text("\n".join(rows))

    map_ = await mapped(FROM_FILE, tmp_path / "poses.csv")

    assert_is_the_drive(map_)
    assert_velocity_is_along_the_drive(map_)


async def test_A9_a_map_from_an_async_iterator_alone(tmp_path: Path) -> None:
    closed = []

    async def poses() -> AsyncIterator[Odometry]:
        truth = drive()
        try:
            for stamp_ns, T in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
                yield Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T))
        finally:
            closed.append(True)

    catalogue = Catalogue({"my_robot": iterator_source(poses, Odometry, port="odometry")})
    operators = "  sensors: {use: my_robot}" + MAPPING

    map_ = await mapped(operators, tmp_path / "nothing", catalogue)

    assert_is_the_drive(map_)
    assert closed == [True]


@pytest.mark.parametrize(
    ("stamps", "kind", "message"),
    [
        ((2, 2), Odometry, "stamps must increase, got 2 after 2 ns"),
        ((1,), ImuBatch, "expected ImuBatch"),
    ],
)
async def test_an_iterator_that_sends_nonsense_is_named(
    stamps: tuple[int, ...], kind: type[Odometry], message: str
) -> None:
    async def poses() -> AsyncIterator[Odometry]:
        for stamp_ns in stamps:
            yield Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity())

    config = IteratorSourceConfig()
    source = iterator_source(poses, kind)

    with pytest.raises(OperatorError, match=message):
        await run_operator(source(config), config=config)  # type: ignore[call-arg]  # every operator takes its config


async def test_C10_okvis_as_a_topic(tmp_path: Path) -> None:
    """OKVIS: nav_msgs/Odometry with a twist."""
    topic = "/okvis/okvis_odometry"
    source = recorded(tmp_path / "okvis.mcap", topic, "nav_msgs/msg/Odometry", with_twist)

    map_ = await mapped(FROM_TOPIC.replace("TOPICS", f"{{odometry: {topic}}}"), source)

    assert_is_the_drive(map_)
    assert_velocity_is_along_the_drive(map_)


async def test_C10_fast_lio2_as_a_topic(tmp_path: Path) -> None:
    """FAST-LIO2: nav_msgs/Odometry whose twist nobody filled in, which is no standstill."""
    source = recorded(tmp_path / "lio.mcap", "/Odometry", "nav_msgs/msg/Odometry", without_twist)

    map_ = await mapped(FROM_TOPIC.replace("TOPICS", "{odometry: /Odometry}"), source)

    assert_is_the_drive(map_)
    assert np.isnan(map_.vertices.velocity_mps).all()


async def test_C10_rovio_with_its_biases_beside_it(tmp_path: Path) -> None:
    """ROVIO: nav_msgs/Odometry, and the biases as sensor_msgs/Imu on a topic of their own."""
    source = recorded(
        tmp_path / "rovio.mcap",
        "/rovio/odometry",
        "nav_msgs/msg/Odometry",
        with_twist,
        biases_topic="/rovio/imu_biases",
    )

    map_ = await mapped(ROVIO_BIASES + MAPPING, source, odometry="adapter.odometry")

    assert_is_the_drive(map_)
    np.testing.assert_allclose(map_.vertices.gyro_bias_radps[-1], GYRO_BIAS)
    np.testing.assert_allclose(map_.vertices.accel_bias_mps2[-1], ACCEL_BIAS)


async def test_A10_biases_in_the_message_are_those_of_the_vertices(tmp_path: Path) -> None:
    """maplab_msgs/OdometryWithImuBiases: the accelerometer's come first, and a state last."""

    def encode(stamp_ns: int, T: np.ndarray) -> bytes:
        biases = np.array([*ACCEL_BIAS, *GYRO_BIAS], "<f8").tobytes()
        odometry = with_twist(stamp_ns, T)
        padding = b"\0" * (-(len(odometry) - 4) % 8)  # CDR aligns after its four bytes of encoding
        return odometry + padding + biases + b"\1\0\0\0"

    schema = "maplab_msgs/msg/OdometryWithImuBiases"
    source = recorded(tmp_path / "maplab.mcap", "/maplab_odom_T_O_I", schema, encode)

    map_ = await mapped(FROM_TOPIC.replace("TOPICS", "{odometry: /maplab_odom_T_O_I}"), source)

    assert_is_the_drive(map_)
    assert_velocity_is_along_the_drive(map_)
    np.testing.assert_array_equal(
        map_.vertices.gyro_bias_radps, np.tile(GYRO_BIAS, (len(map_.vertices), 1))
    )
    np.testing.assert_array_equal(
        map_.vertices.accel_bias_mps2, np.tile(ACCEL_BIAS, (len(map_.vertices), 1))
    )


async def test_the_adapter_makes_the_sensors_poses_those_of_the_base() -> None:
    """A sensor that looks backward, half a metre behind the base; its velocity is not the base's."""
    place = (-0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    T_base_sensor = SE3.from_quat_xyzw(place[3:], place[:3])
    adapter = OdometryAdapter(OdometryAdapterConfig(T_base_sensor=place))
    base = [SE3.exp([0, 0, 0.1 * i, 0.2 * i, 0, 0]) for i in range(3)]
    given = [
        Odometry(stamp_ns=i, T_odom_base=T @ T_base_sensor, velocity_mps=np.ones(3))
        for i, T in enumerate(base)
    ]

    sent = (await run_operator(adapter, odometry=given))["odometry"]

    for message, T_odom_base in zip(sent, base, strict=True):
        np.testing.assert_allclose(message.T_odom_base.matrix, T_odom_base.matrix, atol=1e-12)
        assert message.velocity_mps is None


async def test_the_adapter_undoes_a_twist_in_the_frame_of_the_odometry() -> None:
    T_odom_base = SE3.exp([0, 0, 1.2, 1, 2, 3])
    given = Odometry(
        stamp_ns=1, T_odom_base=T_odom_base, velocity_mps=T_odom_base.R @ [4.0, 5.0, 6.0]
    )

    adapted = OdometryAdapter(OdometryAdapterConfig(velocity="odom")).adapted(given, None)

    assert adapted.velocity_mps is not None
    np.testing.assert_allclose(adapted.velocity_mps, [4, 5, 6])
