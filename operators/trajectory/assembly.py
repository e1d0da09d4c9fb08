"""The parts of a trajectory as its config describes them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mapstream.operators.odometry.uncertainty import diagonal
from mapstream.operators.trajectory.config import (
    ImuConfig,
    OdometryConfig,
    SourceConfig,
    TrajectoryConfig,
    WheelConfig,
)
from mapstream.operators.trajectory.imu_source import ImuSource
from mapstream.operators.trajectory.motion_models import (
    ConstantVelocity,
    MotionModel,
    StandingStill,
)
from mapstream.operators.trajectory.sources import OdometrySource, PoseSource, WheelSource
from mapstream.streams.triggers import AnyOf, OnMotion, Periodic, Trigger

_SECOND_NS = 1_000_000_000


def source_of(config: SourceConfig, keep_ns: int) -> PoseSource:
    """Return an empty source of motion that keeps its messages for so long."""
    if isinstance(config, OdometryConfig):
        step = diagonal(config.sigma_rad, config.sigma_m)
        gap_ns = round(config.max_gap_s * _SECOND_NS)
        return OdometrySource(step, keep_ns=keep_ns, max_gap_ns=gap_ns)
    if isinstance(config, WheelConfig):
        return WheelSource(
            config.sigmas(),
            turn_m_per_rad=config.turn_m_per_rad,
            keep_ns=keep_ns,
            max_gap_ns=round(config.max_gap_s * _SECOND_NS),
        )
    return StandingStill(config.sigmas())


def imu_source_of(config: ImuConfig, keep_ns: int) -> ImuSource:
    """Return an empty IMU that keeps its samples for so long."""
    gap_ns = round(config.max_gap_s * _SECOND_NS)
    return ImuSource(gravity_mps2=config.gravity_mps2, keep_ns=keep_ns, max_gap_ns=gap_ns)


def bridge_of(config: TrajectoryConfig, sources: Mapping[str, PoseSource]) -> MotionModel | None:
    """Return what links poses between which nothing was measured; None: nothing does."""
    if config.bridge == "still":
        return StandingStill()
    return ConstantVelocity(list(sources.values())) if config.bridge != "none" else None


def trigger_of(config: TrajectoryConfig) -> Trigger:
    """Return what makes poses that no measurement asks for; the first one it always makes."""
    triggers: list[Trigger] = [OnMotion(config.distance_m or np.inf, config.rotation_rad or np.inf)]
    if config.period_s is not None:
        triggers.append(Periodic(round(config.period_s * _SECOND_NS)))
    return AnyOf(triggers)
