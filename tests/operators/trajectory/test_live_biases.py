"""Biases that move while a map grows: the samples of its IMU are integrated anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.estimation.factors.inertial import outdated
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.streams.messages.sensors import ImuBatch
from tests.operators.trajectory.drives import MS, imu, odometry

pytestmark = pytest.mark.anyio

GYRO_BIAS = np.array([0.01, -0.02, 0.03])  # [rad/s], ten times what an integral is good for


def biased(batch: ImuBatch) -> ImuBatch:
    return replace(batch, gyro_radps=batch.gyro_radps + GYRO_BIAS)


def inertial_factors(live: LiveMap) -> dict[int, Factor]:
    rows = {live.map.edges.id[row].tobytes(): row for row in live.map.edges_of("imu").tolist()}
    return {rows[name]: f for name, f in live._problem.factors.items() if name in rows}


async def test_F2_a_growing_map_integrates_anew_when_a_bias_has_moved() -> None:
    config = TrajectoryConfig.model_validate(
        {"sources": {"visual": {"kind": "odometry"}}, "imu": {}, "submap_s": 2.0}
    )
    sent = await run_operator(
        Trajectory(config),
        config=config,
        visual=[odometry(s) for s in range(0, 10_001 * MS, 100 * MS)],
        imu=[biased(imu(s)) for s in range(40 * MS, 10_041 * MS, 50 * MS)],
    )
    live = LiveMap(OptimizeConfig(underconstrained="prior"))

    for submap in sent["submaps"]:
        live.append(submap)
        factors = inertial_factors(live)
        assert len(factors) == len(live.map.edges_of("imu"))
        assert outdated(live.map, factors) == []

    np.testing.assert_allclose(live.map.vertices.gyro_bias_radps[-1], GYRO_BIAS, atol=2e-3)
    for factor in inertial_factors(live).values():
        made_with = factor.preintegratedMeasurements().biasHat().gyroscope()
        np.testing.assert_allclose(made_with, GYRO_BIAS, atol=5e-3)
