"""Playing recordings: order, pace, stamps, extrinsics, batches, epochs, damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from mapstream.operators.operator import Context, Ports, set_context
from mapstream.operators.signature import signature_of
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig, TopicConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import Channel, open_recording
from mapstream.streams.channel import Channel as Edge
from mapstream.streams.channel import Limits, Receiver, Sender
from mapstream.streams.clock import ReplayClock
from mapstream.streams.errors import DecodeError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan, TransformBatch
from tests.data import shared

pytestmark = pytest.mark.anyio

_START_NS = 1_700_000_000 * 10**9
_MS = 1_000_000


def _scan(stamp_ns: int, frame: str = "lidar") -> LidarScan:
    return LidarScan(stamp_ns=stamp_ns, points=np.ones((4, 3), np.float32), frame=frame)


def _imu(stamp_ns: int) -> ImuBatch:
    row = np.full((1, 3), float(stamp_ns % 1000))
    return ImuBatch(stamps_ns=np.array([stamp_ns]), gyro_radps=row, accel_mps2=row)


def _record(path: Path, *, imu_ahead_ns: int = 0) -> Path:
    """Two seconds: a scan each 100 ms, an IMU sample each 5 ms."""
    with McapWriter(path) as writer:
        for k in range(400):
            log_ns = _START_NS + 5 * _MS * k
            writer.write("/imu", _imu(log_ns + imu_ahead_ns), log_ns)
            if k % 20 == 0:
                writer.write("/points", _scan(log_ns - 3 * _MS), log_ns)
    return path


def _context(rate: float | None = None, clock: ReplayClock | None = None) -> Context:
    return Context(clock=clock or ReplayClock(rate))


async def _run(
    path: Path,
    topics: dict[str, Any],
    run_context: Context | None = None,
    **options: Any,  # noqa: ANN401
) -> dict[str, list[Any]]:
    config = McapSourceConfig(path=path, topics=topics, **options)
    return await run_operator(
        McapSource(config), config=config, run_context=run_context or _context()
    )


async def test_messages_leave_with_stamp_frame_and_record(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")
    run_context = _context()

    out = await _run(path, {"scans": "/points", "imu": "/imu"}, run_context)

    scans = out["scans"]
    assert [s.stamp_ns for s in scans] == [_START_NS + (100 * k - 3) * _MS for k in range(20)]
    assert scans[3].record.log_ns == _START_NS + 300 * _MS
    assert (scans[3].record.path, scans[3].record.topic) == (str(path), "/points")
    with open_recording(path) as recording:
        (again,) = recording.messages(
            ["/points"], scans[3].record.log_ns, scans[3].record.log_ns + 1
        )
        assert decoder_for(again.channel)(again).stamp_ns == scans[3].stamp_ns
    assert run_context.activity.position_ns == _START_NS + 1995 * _MS
    assert run_context.activity.span_ns == (_START_NS, _START_NS + 1995 * _MS + 1)
    assert not run_context.activity.warnings
    assert not run_context.activity.losses


async def test_imu_samples_come_in_batches_of_log_time_and_none_is_lost(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")

    batches = (await _run(path, {"imu": "/imu"}, imu_batch_s=0.05))["imu"]
    alone = (await _run(path, {"imu": "/imu", "scans": "/points"}, imu_batch_s=0.05))["imu"]

    assert {len(batch.stamps_ns) for batch in batches} == {10}
    stamps = np.concatenate([batch.stamps_ns for batch in batches])
    np.testing.assert_array_equal(stamps, _START_NS + 5 * _MS * np.arange(400))
    assert [b.stamps_ns.tolist() for b in alone] == [b.stamps_ns.tolist() for b in batches]


async def test_batches_do_not_depend_on_where_playing_begins(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")

    whole = (await _run(path, {"imu": "/imu"}))["imu"]
    later = (await _run(path, {"imu": "/imu"}, start_s=1.0, end_s=1.5))["imu"]

    assert [b.stamp_ns for b in later] == [b.stamp_ns for b in whole[20:30]]


async def test_A21_an_offset_moves_all_stamps(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")
    topics: dict[str, Any] = {
        "imu": {"topic": "/imu", "offset_s": 0.02},
        "scans": {"topic": "/points", "stamp": "log", "offset_s": -0.1},
    }

    out = await _run(path, topics)

    assert out["imu"][0].stamps_ns[0] == _START_NS + 20 * _MS
    assert [s.stamp_ns for s in out["scans"]] == [
        _START_NS + 100 * _MS * (k - 1) for k in range(20)
    ]


async def test_bounds_keep_their_promise_and_move_on_for_silent_ports(tmp_path: Path) -> None:
    """No message comes behind its port's bound, and joins need not wait for the end."""
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        for k in range(100):
            log_ns = _START_NS + 10 * _MS * k
            writer.write("/imu", _imu(log_ns + 3_100 * _MS), log_ns)  # ahead
            if k % 10 == 5:
                writer.write("/points", _scan(log_ns - 120 * _MS), log_ns)  # behind
            if k == 0:
                writer.write("/rare", _scan(log_ns), log_ns)
    config = McapSourceConfig(
        path=path, topics={"imu": "/imu", "scans": "/points", "scans_b": "/rare"}
    )
    edges = {port: Edge[Any](port, Limits(capacity=10**6)) for port in config.topics}
    set_context(_context())

    await McapSource(config).run(
        signature_of(McapSource, config).inputs_type(),
        Ports(**{p: Sender([e]) for p, e in edges.items()}),
    )

    assert {edge.stats.late for edge in edges.values()} == {0}
    assert edges["scans_b"].bound_ns > _START_NS + 600 * _MS
    assert edges["scans"].bound_ns > _START_NS + 500 * _MS


async def test_A19_extrinsics_come_from_transform_topics(tmp_path: Path) -> None:
    """A static mounting, and a turning one that is asked at each stamp."""
    mount, path = SE3.exp([0.1, 0.2, 0.3, 1, 2, 3]), tmp_path / "a.mcap"

    def turned(k: int) -> SE3:
        return SE3.exp([0, 0, 0.1 * k, 0, 0, 0])

    def transform(stamp_ns: int, parent: str, child: str, T: SE3) -> TransformBatch:
        return TransformBatch(
            stamps_ns=np.array([stamp_ns]), parents=(parent,), children=(child,),
            T_parent_child=T.matrix[None], is_static=child == "mast",
        )  # fmt: skip

    with McapWriter(path) as writer:
        for k in range(11):
            log_ns = _START_NS + 100 * _MS * k
            writer.write("/tf", transform(log_ns, "mast", "pan", turned(k)), log_ns)
            if 0 < k < 10:
                writer.write("/points", _scan(log_ns + 50 * _MS, "pan"), log_ns)
                writer.write("/fixed", _scan(log_ns, "mast"), log_ns)
                writer.write("/other", _scan(log_ns, "nowhere"), log_ns)
        end_ns = _START_NS + 2000 * _MS
        writer.write("/tf_static", transform(_START_NS, "base_link", "mast", mount), end_ns)
    run_context = _context()

    out = await _run(
        path, {"scans": "/points", "scans_b": "/fixed", "scans_c": "/other"}, run_context
    )

    for k, scan in enumerate(out["scans"], start=1):
        expected = mount @ SE3.exp([0, 0, 0.1 * (k + 0.5), 0, 0, 0])
        np.testing.assert_allclose(scan.T_base_sensor.matrix, expected.matrix, atol=1e-9)
    assert len(out["scans"]) == 9
    np.testing.assert_allclose(out["scans_b"][0].T_base_sensor.matrix, mount.matrix)
    np.testing.assert_allclose(out["scans_c"][0].T_base_sensor.matrix, np.eye(4))
    assert list(run_context.activity.warnings) == [
        "no transform leads from nowhere to base_link: one is the other"
    ]


_RIG = """
sensors:
  - {id: "00000000000000000000000000000001", sensor_type: IMU, topic: /imu, frame: imu_link}
  - id: "00000000000000000000000000000002"
    sensor_type: LIDAR
    topic: /points
    frame: top_lidar
    time_offset_ns: 7000000
extrinsics:
  - sensor_id: "00000000000000000000000000000002"
    base_sensor_id: "00000000000000000000000000000001"
    T_B_S: [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
"""


async def test_A21_a_sensor_file_gives_places_frames_and_time_offsets(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(_RIG)
    path = _record(tmp_path / "a.mcap")

    out = await _run(path, {"scans": "/points", "imu": "/imu"}, rig=tmp_path / "rig.yaml")

    scan, imu = out["scans"][1], out["imu"][0]
    assert (scan.frame, imu.frame) == ("top_lidar", "imu_link")
    assert scan.stamp_ns == _START_NS + (100 - 3 + 7) * _MS
    np.testing.assert_allclose(scan.T_base_sensor.t, [1, 2, 3])
    np.testing.assert_allclose(imu.T_base_sensor.matrix, np.eye(4))


async def test_a_message_whose_place_is_not_known_at_its_time_is_a_loss(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        for k in range(3):
            log_ns = _START_NS + 100 * _MS * k
            batch = TransformBatch(
                stamps_ns=np.array([log_ns]), parents=("base_link",), children=("lidar",),
                T_parent_child=np.eye(4)[None],
            )  # fmt: skip
            writer.write("/tf", batch, log_ns)
            writer.write("/points", _scan(log_ns - 50 * _MS), log_ns)
    run_context = _context()

    out = await _run(path, {"scans": "/points"}, run_context)

    assert len(out["scans"]) == 2
    assert list(run_context.activity.losses.values()) == [1]
    assert "/points: messages without a place: lidar in base_link" in next(
        iter(run_context.activity.losses)
    )


def _odometry(stamp_ns: int) -> Odometry:
    return Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.identity())


async def _stamps_of(
    path: Path,
    offsets_ms: list[int],
    **options: Any,  # noqa: ANN401
) -> tuple[list[int], dict[str, int]]:
    """Play odometry whose stamps have these offsets from a message each 100 ms."""
    with McapWriter(path) as writer:
        for k, offset in enumerate(offsets_ms):
            log_ns = _START_NS + 100 * _MS * k
            writer.write("/odom", _odometry(log_ns + offset * _MS), log_ns)
    run_context = _context()
    out = await _run(path, {"odometry": "/odom"}, run_context)
    return [m.stamp_ns for m in out["odometry"]], run_context.activity.warnings


async def test_B15_odd_stamps_are_counted_by_topic_and_the_run_goes_on(tmp_path: Path) -> None:
    stamps, warnings = await _stamps_of(tmp_path / "a.mcap", [0, 0, -150, 0, -100, 0])

    assert len(stamps) == 6
    assert warnings == {
        f"{tmp_path / 'a.mcap'}: /odom: stamps {what}, first at log time {_START_NS + at * _MS} ns": 1
        for what, at in [("run backwards", 200), ("repeat", 400)]
    }


async def test_B15_stamps_of_zero_take_the_log_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        for k in range(3):
            writer.write("/odom", _odometry(0), _START_NS + k)
    run_context = _context()

    out = await _run(path, {"odometry": "/odom"}, run_context)

    assert [m.stamp_ns for m in out["odometry"]] == [_START_NS, _START_NS + 1, _START_NS + 2]
    (warning,) = run_context.activity.warnings.items()
    assert warning == (
        f"{path}: /odom: stamps of zero, the log time is used, first at log time {_START_NS} ns",
        3,
    )


async def test_B15_stamps_in_another_unit_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        for k in range(3):
            writer.write(
                "/odom", _odometry((_START_NS + 100 * _MS * k) // 1000), _START_NS + 100 * _MS * k
            )
    run_context = _context()

    await _run(path, {"odometry": "/odom"}, run_context)

    text = f"{path}: /odom: stamps are in microseconds, not nanoseconds"
    assert text in run_context.activity.warnings


@pytest.mark.parametrize(("jump_ms", "way"), [(-9_000, "backward"), (9_000, "forward")])
async def test_B15_a_clock_that_jumps_starts_an_epoch(
    tmp_path: Path, jump_ms: int, way: str
) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        for k in range(40):
            log_ns = _START_NS + 100 * _MS * k
            offset_ns = jump_ms * _MS if k >= 25 else 0
            writer.write("/odom", _odometry(log_ns + offset_ns), log_ns)
    config = McapSourceConfig(path=path, topics={"odometry": "/odom"})
    edge = Edge[Any]("odometry", Limits(capacity=1000))
    run_context = _context()
    set_context(run_context)

    await McapSource(config).run(
        signature_of(McapSource, config).inputs_type(), Ports(odometry=Sender([edge]))
    )
    edge.close()

    receiver = Receiver(edge, spans_epochs=True)
    epochs = [receiver.arrival.epoch async for _ in receiver]
    assert epochs == [0] * 25 + [1] * 15
    (warning,) = run_context.activity.warnings
    first_ns = _START_NS + 2_500 * _MS
    assert warning == f"{path}: /odom: its clock jumps {way}, first at log time {first_ns} ns"
    assert edge.stats.late == 0


async def test_B13_a_seek_starts_an_epoch_at_its_target(tmp_path: Path) -> None:
    clock = ReplayClock(None)
    config = McapSourceConfig(path=_record(tmp_path / "a.mcap"), topics={"scans": "/points"})
    edge = Edge[Any]("scans", Limits(capacity=1000))
    set_context(_context(clock=clock))
    clock.seek(_START_NS + 1_500 * _MS)

    await McapSource(config).run(
        signature_of(McapSource, config).inputs_type(), Ports(scans=Sender([edge]))
    )
    edge.close()

    receiver = Receiver(edge, spans_epochs=True)
    found = [(m.record.log_ns, receiver.arrival.epoch) async for m in receiver]
    assert found == [(_START_NS + 100 * k * _MS, 1) for k in range(15, 20)]


async def test_messages_that_cannot_be_decoded_are_losses_or_stop_the_run(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        writer.write("/points", _scan(_START_NS))
        with open_recording(_record(tmp_path / "b.mcap")) as recording:
            channel = recording.topics["/points"].channel
        writer.write_raw(channel, b"\xff\xff\xff", _START_NS + 1)
        writer.write("/points", _scan(_START_NS + 2))
    run_context = _context()

    out = await _run(path, {"scans": "/points"}, run_context)

    assert [s.stamp_ns for s in out["scans"]] == [_START_NS, _START_NS + 2]
    ((text, count),) = run_context.activity.losses.items()
    assert count == 1
    assert "a.mcap: /points: messages that cannot" in text
    assert f"mapstream.LidarScan at log time {_START_NS + 1}" in text
    with pytest.raises(DecodeError, match=r"mapstream.LidarScan at log time"):
        await _run(path, {"scans": "/points"}, on_error="stop")


async def test_damage_in_the_file_is_a_loss_and_the_rest_is_played(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")
    content = bytearray(path.read_bytes())
    path.write_bytes(content[: len(content) // 2])
    run_context = _context()

    out = await _run(path, {"imu": "/imu"}, run_context)

    assert len(out["imu"]) > 0
    assert any(str(path) in text for text in run_context.activity.losses)


async def test_what_does_not_fit_is_refused_with_a_reason(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap")

    with pytest.raises(RecordingError, match=r"no topic /pints; there are: /imu, /points"):
        await _run(path, {"scans": "/pints"})
    with pytest.raises(ValidationError, match=r"no message 'Scan'; known: CameraCalibration"):
        McapSourceConfig(path=path, topics={"x": TopicConfig(topic="/points", type="Scan")})
    with pytest.raises(ValidationError, match="no topics"):
        McapSourceConfig(path=path, topics={})
    image = Channel(
        topic="/cam", message_encoding="cdr", schema_name="sensor_msgs/msg/CompressedImage"
    )
    with McapWriter(tmp_path / "b.mcap") as writer:
        writer.write_raw(image, b"", _START_NS)
    with pytest.raises(
        DecodeError,
        match=r"port frames: /cam: .*decodes to EncodedImage, not to CameraFrame; read it as `images`",
    ):
        await _run(tmp_path / "b.mcap", {"frames": "/cam"})


def test_ports_have_the_types_that_their_names_say(tmp_path: Path) -> None:
    topics: dict[str, Any] = {
        "scans": "/a", "scans_rear": "/b", "imu": "/c", "things": "/d",
        "other": {"topic": "/e", "type": "Odometry"},
    }  # fmt: skip
    config = McapSourceConfig(path=tmp_path, topics=topics)

    ports = signature_of(McapSource, config).outputs

    assert {name: port.message_type for name, port in ports.items()} == {
        "scans": LidarScan, "scans_rear": LidarScan, "imu": ImuBatch, "things": Any,
        "other": Odometry,
    }  # fmt: skip


async def test_B14_playing_twice_gives_the_same_messages_at_any_rate(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.mcap", imu_ahead_ns=3_100 * _MS)
    topics = {"scans": "/points", "imu": "/imu"}

    fast = await _run(path, topics)
    paced = await _run(path, topics, _context(rate=50.0))

    for port, messages in fast.items():
        assert [m.stamp_ns for m in messages] == [m.stamp_ns for m in paced[port]]


async def test_a_real_recording_plays(tmp_path: Path) -> None:
    path = shared("kitti_camera_lidar/kitti_camera_lidar.mcap")
    run_context = _context()

    out = await _run(
        path, {"scans": "/velodyne_points", "images": "/camera/image/compressed"}, run_context
    )

    assert [len(messages) for messages in out.values()] == [16, 16]
    assert all(np.isfinite(scan.points).all() for scan in out["scans"])
    assert out["images"][0].format in ("png", "jpeg")
