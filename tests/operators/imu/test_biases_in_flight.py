"""Biases of an IMU that flies through W-VI, from odometry that has none."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.imu.biases import ImuBiases, ImuBiasesConfig
from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch

pytestmark = pytest.mark.anyio


@pytest.mark.slow
async def test_C13_biases_of_a_flight_through_w_vi() -> None:
    """The odometry is as good as a stereo camera's; one that turns wrong makes a bias of its own."""
    config = WViConfig.model_validate(
        {
            "cameras": ["front_left"],
            "camera": {"width_px": 32, "height_px": 24, "rate_hz": 0.1},
            "flight": {"duration_s": 10.0, "start": "moving"},
            "texel_m": 0.2,
            "odometry_drift": 0.002,
            "odometry_turn_radpm": 0.0,
        }
    )
    records = list(w_vi(config, 0).records)
    imu = [r.message for r in records if isinstance(r.message, ImuBatch)]
    odometry = [r.message for r in records if r.topic == "/odometry"]
    truth = next(r.message for r in records if r.topic == "/truth")
    assert isinstance(truth, Odometry)
    assert truth.gyro_bias_radps is not None
    assert truth.accel_bias_mps2 is not None
    quality = ImuQuality(gyro_density=1.7e-4, accel_density=2e-3)

    out = await run_operator(ImuBiases(ImuBiasesConfig(imu=quality)), imu=imu, odometry=odometry)

    found = out["odometry"][0]
    off = np.linalg.norm(found.gyro_bias_radps - truth.gyro_bias_radps)
    assert off < 0.1 * np.linalg.norm(truth.gyro_bias_radps)
    assert found.accel_bias_mps2 == pytest.approx(truth.accel_bias_mps2, abs=0.05)
