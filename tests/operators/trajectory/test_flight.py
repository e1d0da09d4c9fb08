"""The IMU of W-VI, from the sensor file in a recording to edges of a map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.worlds.catalogue import simulate
from tests.operators.flights import OPTIONS, Flight, mapped

pytestmark = pytest.mark.anyio


async def test_A1_the_imu_of_a_flight_reaches_the_map_as_its_recording_describes_it(
    tmp_path: Path,
) -> None:
    """Densities, walks, limits and gravity come from the attached file; tilt and biases out of the edges."""
    path = simulate("w_vi", tmp_path / "w.mcap", **OPTIONS | {"flight": {"duration_s": 1.0}})
    flight = Flight(0)

    map_ = await mapped(flight, {"recording": path})

    imu = json.loads(map_.missions.sensors[0])["imu"]
    assert imu["gyro_density"] == 1.7e-4
    assert imu["accel_random_walk"] == 3.0e-4
    assert (imu["max_gyro_radps"], imu["max_accel_mps2"], imu["gravity_mps2"]) == (15, 150, 9.81)
    assert len(map_.edges_of("imu")) == len(map_.vertices) - 1
    up = map_.T_map_base(np.arange(len(map_.vertices)))[:, 2, :3]
    true_up = flight.path.at(map_.vertices.stamp_ns)[:, 2, :3]
    tilts_rad = np.arccos(np.clip((up * true_up).sum(axis=1), -1, 1))
    assert np.degrees(tilts_rad).max() < 0.2
    last = flight.truth[-1]
    assert last.accel_bias_mps2 is not None
    assert np.abs(map_.vertices.accel_bias_mps2[-1] - last.accel_bias_mps2).max() < 0.01
