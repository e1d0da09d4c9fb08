"""A recording that brings its sensor file along needs no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.rig_file import write_rig
from mapstream.streams.sensors import Sensor

pytestmark = pytest.mark.anyio
LIDAR = Sensor(id="1" * 32, kind="lidar", topic="/points", frame="lidar", time_offset_ns=7)
IMU = Sensor(id="2" * 32, kind="imu", frame="imu")


def rig_at(x_m: float) -> Rig:
    T_base_sensor = SE3.from_rotation(np.eye(3), [x_m, 0, 0])
    places = [
        Extrinsics(sensor_id=IMU.id, base_sensor_id=IMU.id, T_base_sensor=SE3.identity()),
        Extrinsics(sensor_id=LIDAR.id, base_sensor_id=IMU.id, T_base_sensor=T_base_sensor),
    ]
    return Rig([LIDAR, IMU], places)


async def played(path: Path, rig: Path | None = None) -> LidarScan:
    config = McapSourceConfig(path=path, topics={"scans": "/points"}, rig=rig)
    sent = await run_operator(McapSource(config), config=config)
    (scan,) = sent["scans"]
    assert isinstance(scan, LidarScan)
    return scan


async def test_places_and_offsets_come_from_the_recording_unless_a_file_is_given(
    tmp_path: Path,
) -> None:
    points = np.zeros((3, 3), np.float32)
    with McapWriter(tmp_path / "drive.mcap") as writer:
        attach_rig(writer, rig_at(1.0))
        writer.write("/points", LidarScan(stamp_ns=1000, points=points, frame="lidar"))
    write_rig(rig_at(2.0), tmp_path / "sensors.yaml")

    attached = await played(tmp_path / "drive.mcap")
    given = await played(tmp_path / "drive.mcap", tmp_path / "sensors.yaml")

    assert (attached.stamp_ns, attached.T_base_sensor.t[0]) == (1007, 1.0)
    assert given.T_base_sensor.t[0] == 2.0
