"""Flights through the hall of W-VI without its images: inertial samples, odometry and fixes, with truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps.model import Map
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import GnssFix, ImuBatch
from mapstream.streams.trajectory import Trajectory as Path

OPTIONS: dict[str, Any] = {
    "flight": {"duration_s": 30.0},
    "satellites": {"rate_hz": 5.0},
    "cameras": ("rear",),
    "camera": {"width_px": 32, "height_px": 24, "rate_hz": 0.01},
    "texel_m": 0.1,
}
NOISE = {
    "gyro_density": 1.7e-4,
    "accel_density": 2.0e-3,
    "gyro_random_walk": 2.0e-5,
    "accel_random_walk": 3.0e-4,
}


class Flight:
    """The messages of one flight, and where the base truly was."""

    def __init__(self, seed: int) -> None:
        records = list(w_vi(WViConfig.model_validate(OPTIONS), seed).records)
        self.imu = [r.message for r in records if isinstance(r.message, ImuBatch)]
        self.fixes = [r.message for r in records if isinstance(r.message, GnssFix)]
        poses = [(r.topic, r.message) for r in records if isinstance(r.message, Odometry)]
        self.odometry = [message for topic, message in poses if topic == "/odometry"]
        self.truth = [message for topic, message in poses if topic == "/truth"]
        self.path = Path(
            stamps_ns=np.array([m.stamp_ns for m in self.truth]),
            poses=np.stack([m.T_odom_base.matrix for m in self.truth]),
        )


async def mapped(flight: Flight, imu: dict[str, Any], **inputs: Any) -> Map:  # noqa: ANN401
    """Return the optimised map of a flight's IMU and odometry, and of constraints by name."""
    config = TrajectoryConfig.model_validate(
        {
            "sources": {"odometry": {"kind": "odometry"}},
            "imu": imu,
            "constraints": {name: {} for name in inputs},
        }
    )
    sent = await run_operator(
        Trajectory(config), config=config, imu=flight.imu, odometry=flight.odometry, **inputs
    )
    live = LiveMap(OptimizeConfig(underconstrained="prior"))
    for submap in sent["submaps"]:
        live.append(submap)
    live.finish()
    return live.map
