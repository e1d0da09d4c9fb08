"""The IMU's noise, from the graph file, a sensor file, or the one attached to the recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapstream.operators.trajectory.config import ImuConfig, TrajectoryConfig
from mapstream.operators.trajectory.rig_imu import with_rig
from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import ConfigError
from mapstream.streams.rig import Rig
from mapstream.streams.rig_file import write_rig
from mapstream.streams.sensors import ImuNoise, ImuSensor

NOISE = ImuNoise(
    gyro_density=3e-3, gyro_random_walk=3e-5, accel_density=3e-2, accel_random_walk=3e-4
)
RIG = Rig([ImuSensor(id="0" * 32, noise=NOISE, gravity_mps2=9.79)])


def resolved(**imu: object) -> ImuConfig:
    config = with_rig(TrajectoryConfig.model_validate({"imu": imu})).imu
    assert config is not None
    return config


def test_A18_the_graph_file_counts_before_the_sensor_file(tmp_path: Path) -> None:
    write_rig(RIG, tmp_path / "rig.yaml")

    imu = resolved(rig=tmp_path / "rig.yaml", gyro_density=0.5)

    assert (imu.gyro_density, imu.accel_density, imu.gravity_mps2) == (0.5, 3e-2, 9.79)


def test_A18_the_recording_says_how_good_its_imu_is_if_no_file_does(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "attached.mcap") as writer:
        attach_rig(writer, RIG)
    with McapWriter(tmp_path / "bare.mcap"):
        pass

    attached = resolved(rig="", recording=tmp_path / "attached.mcap")
    bare = resolved(rig="", recording=tmp_path / "bare.mcap")

    assert (attached.gyro_density, attached.gravity_mps2) == (3e-3, 9.79)
    assert bare.gyro_density == ImuConfig().gyro_density


def test_A18_a_sensor_file_without_an_imu_is_an_error(tmp_path: Path) -> None:
    write_rig(Rig(), tmp_path / "rig.yaml")

    with pytest.raises(ConfigError, match="0 sensors of kind imu"):
        resolved(rig=tmp_path / "rig.yaml")
