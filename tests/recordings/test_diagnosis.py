"""What the doctor finds in recordings whose faults we know."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.diagnosis import Diagnosis, diagnose
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import Channel, open_recording
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan
from tests.data import shared

_START_NS = 1_700_000_000 * 10**9
_MS = 1_000_000


def _scan(stamp_ns: int, offsets_ns: np.ndarray | None = None) -> LidarScan:
    points = np.ones((10, 3), np.float32)
    ring, intensity = np.zeros(10, np.uint16), np.zeros(10, np.float32)
    times = np.arange(10) * 9 * _MS if offsets_ns is None else offsets_ns
    return LidarScan(
        stamp_ns=stamp_ns, points=points, ring=ring, intensity=intensity, offsets_ns=times
    )


def _imu(stamp_ns: int, accel: tuple[float, float, float] = (0, 0, 9.81)) -> ImuBatch:
    return ImuBatch(
        stamps_ns=np.array([stamp_ns]), gyro_radps=np.zeros((1, 3)), accel_mps2=np.array([accel])
    )


def _examine(
    path: Path,
    *,
    imu: Callable[[int], ImuBatch | None] = _imu,
    scan: Callable[[int], LidarScan | None] = _scan,
) -> Diagnosis:
    """Record three seconds of IMU, scans and odometry, and diagnose them."""
    with McapWriter(path) as writer:
        for k in range(300):
            log_ns = _START_NS + 10 * _MS * k
            sample = imu(log_ns)
            if sample is not None:
                writer.write("/imu", sample, log_ns)
            cloud = scan(log_ns) if k % 10 == 0 else None
            if cloud is not None:
                writer.write("/points", cloud, log_ns)
            if k % 5 == 0:
                pose = Odometry(stamp_ns=log_ns, T_odom_base=SE3.identity())
                writer.write("/odom", pose, log_ns)
    with open_recording(path) as recording:
        return diagnose(recording)


def _warnings(diagnosis: Diagnosis) -> dict[tuple[str, str], str]:
    return {(f.topic, f.name): f.text for f in diagnosis.findings if f.severity == "warning"}


def test_a_good_recording_is_clean(tmp_path: Path) -> None:
    diagnosis = _examine(tmp_path / "a.mcap")

    assert diagnosis.is_clean
    assert _warnings(diagnosis) == {}
    rates = {health.topic: round(health.rate_hz, 2) for health in diagnosis.topics}
    assert rates == {"/imu": 100.0, "/points": 10.0, "/odom": 20.0}
    assert diagnosis.duration_s == pytest.approx(2.99)
    notes = [(f.topic, f.name, f.text) for f in diagnosis.findings]
    assert notes == [("/imu", "imu_axes", "+z points up, tilted by 0.0 deg")]


def test_B15_an_imu_that_is_ahead_is_named_with_the_remedy(tmp_path: Path) -> None:
    diagnosis = _examine(tmp_path / "a.mcap", imu=lambda t: _imu(t + 3_100 * _MS))

    assert _warnings(diagnosis) == {
        (
            "/imu",
            "clock_offset",
        ): "its clock is 3.100 s ahead of the other topics; try `offset_s: -3.100`"
    }


def test_B15_backward_jumps_duplicates_and_gaps_are_named(tmp_path: Path) -> None:
    def late(t: int) -> ImuBatch:
        return _imu(t - (20 * _MS if t == _START_NS + 1000 * _MS else 0))

    def jumping(t: int) -> ImuBatch:
        return _imu(t - (7_000 * _MS if t > _START_NS + 2_500 * _MS else 0))

    def repeating(t: int) -> ImuBatch:
        return _imu(t - (10 * _MS if t == _START_NS + 1000 * _MS else 0))

    def gapped(t: int) -> ImuBatch | None:
        return None if 1000 * _MS <= t - _START_NS < 1500 * _MS else _imu(t)

    found = {
        made.__name__: _warnings(_examine(tmp_path / f"{made.__name__}.mcap", imu=made))
        for made in (late, jumping, repeating, gapped)
    }

    assert found["late"] == {
        ("/imu", "backwards_stamps"): "1 stamps run backwards, by up to 0.010000 s"
    }
    assert found["jumping"] == {
        ("/imu", "stamp_jump"): "the clock jumps 1 times, by up to -7.000 s, first at 2.510 s"
    }
    assert found["repeating"] == {("/imu", "duplicate_stamps"): "1 stamps repeat the one before"}
    assert found["gapped"] == {("/imu", "gap"): "1 gaps, the longest 0.510 s at 0.990 s"}


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (1e-3, "stamps are in microseconds, not nanoseconds"),
        (1e-9, "stamps are in seconds, not nanoseconds"),
    ],
)
def test_B15_stamps_in_a_wrong_unit_are_named(tmp_path: Path, factor: float, text: str) -> None:
    diagnosis = _examine(tmp_path / "a.mcap", scan=lambda t: _scan(int(t * factor)))

    assert _warnings(diagnosis)["/points", "unit_error"] == text


def test_zero_stamps_are_named(tmp_path: Path) -> None:
    diagnosis = _examine(tmp_path / "a.mcap", scan=lambda _: _scan(0))

    assert _warnings(diagnosis) == {
        ("/points", "zero_stamps"): "30 stamps are zero; try `stamp: log`"
    }


@pytest.mark.parametrize(
    ("accel", "name", "text"),
    [
        ((0, 0, 1.0), "imu_units", "accelerations seem to be in g: 1 at rest instead of 9.81"),
        ((0.1, 0, 0.1), "imu_gravity", "gravity was taken out"),
        ((0, 0, 13.0), "imu_gravity", "the usual acceleration is 13.000 m/s^2 instead of 9.81"),
    ],
)
def test_U6_gravity_tells_the_unit(
    tmp_path: Path, accel: tuple[float, float, float], name: str, text: str
) -> None:
    diagnosis = _examine(tmp_path / "a.mcap", imu=lambda t: _imu(t, accel))

    assert text in _warnings(diagnosis)["/imu", name]


def test_point_times_in_microseconds_equal_or_missing_are_named(tmp_path: Path) -> None:
    micro = _examine(tmp_path / "a.mcap", scan=lambda t: _scan(t, np.arange(10) * 10_000))
    equal = _examine(tmp_path / "b.mcap", scan=lambda t: _scan(t, np.full(10, 5)))
    none = _examine(
        tmp_path / "c.mcap",
        scan=lambda t: LidarScan(stamp_ns=t, points=np.ones((3, 3), np.float32)),
    )
    empty = _examine(
        tmp_path / "d.mcap",
        scan=lambda t: LidarScan(stamp_ns=t, points=np.ones((0, 3), np.float32)),
    )

    assert "perhaps they are in microseconds" in _warnings(micro)["/points", "point_time_span"]
    assert _warnings(equal)["/points", "equal_point_times"].startswith("30 of 30 clouds")
    assert "deskewed" in _warnings(none)["/points", "no_point_times"]
    assert _warnings(empty) == {("/points", "empty_clouds"): "30 of 30 clouds are empty"}


def test_losses_and_what_cannot_be_decoded_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    odd = Channel(
        topic="/odd", message_encoding="cdr", schema_name="velodyne_msgs/msg/VelodyneScan"
    )
    broken = Channel(topic="/broken", message_encoding="cdr", schema_name="sensor_msgs/msg/Imu")
    with McapWriter(path, chunk_bytes=100) as writer:
        for k in range(20):
            writer.write_raw(odd, bytes(60), _START_NS + k)
            writer.write_raw(broken, b"\x00\x01", _START_NS + k)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.4)])

    with open_recording(path) as recording:
        diagnosis = diagnose(recording)

    assert diagnosis.losses
    names = {(f.topic, f.name) for f in diagnosis.findings}
    assert names >= {("/odd", "no_decoder"), ("/broken", "undecodable")}
    assert not diagnosis.is_clean


@pytest.mark.slow
def test_a_real_recording() -> None:
    seen: list[int] = []
    with open_recording(shared("husky/husky_imu_odom_gps.mcap")) as recording:
        diagnosis = diagnose(recording, seen.append)

    health = {h.topic: h for h in diagnosis.topics}
    assert health["/imu/data"].rate_hz == pytest.approx(30, rel=0.05)
    assert health["/fix"].num_read == 989
    assert not diagnosis.losses
    assert ("/imu/data", "imu_axes") in {(f.topic, f.name) for f in diagnosis.findings}
    assert seen == sorted(seen)
