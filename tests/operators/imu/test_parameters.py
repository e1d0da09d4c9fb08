"""From what a graph file or a rig says of an IMU to the factors of a map."""

from __future__ import annotations

import json

import numpy as np

from mapstream.operators.estimation.factors.inertial import parameters_of
from mapstream.operators.imu.parameters import ImuParameters
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.streams.geometry import SE3
from mapstream.streams.sensors import ImuNoise, ImuSensor
from tests.operators.estimation.problems import with_mission

MOUNT = SE3.exp([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])


def test_A1_the_graph_files_imu_is_that_of_the_edges() -> None:
    given = {
        "gyro_density": 2e-4,
        "accel_density": 3e-3,
        "gyro_random_walk": 4e-6,
        "accel_random_walk": 5e-4,
        "gravity_mps2": 9.80665,
        "max_gyro_radps": 8.0,
        "max_accel_mps2": 150.0,
    }
    config = TrajectoryConfig.model_validate({"imu": given})
    sensors = json.loads(config.described(MOUNT))

    map_ = with_mission(np.eye(4)[None], sensors=sensors)

    found = parameters_of(map_, 0)
    assert {name: getattr(found, name) for name in given} == given
    np.testing.assert_allclose(found.T_base_sensor[:3], MOUNT.t)
    np.testing.assert_allclose(found.T_base_sensor[3:], MOUNT.quat_xyzw)


def test_A1_a_rig_files_imu_is_the_same() -> None:
    noise = ImuNoise(
        gyro_density=1e-4, accel_density=2e-3, gyro_random_walk=3e-6, accel_random_walk=4e-5
    )
    sensor = ImuSensor(id="0" * 32, noise=noise, max_accel_mps2=150.0, gravity_mps2=9.8)

    found = ImuParameters.from_sensor(sensor)

    assert found.accel_density == noise.accel_density
    assert found.gyro_random_walk == noise.gyro_random_walk
    assert (found.max_accel_mps2, found.max_gyro_radps, found.gravity_mps2) == (150.0, None, 9.8)
    assert ImuParameters.from_description(found.description()) == found
    assert ImuParameters.from_sensor(ImuSensor(id="0" * 32)) == ImuParameters()
