"""A measurement: the IMU felt that the robot stood still between two keyframes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.streams import SE3, ImuBatch, LoopReport, Receiver, RelativePose, Sender, Submap
from mapstream.streams.sync import anchored, window

_COVARIANCE = np.diag([1e-10] * 3 + [1e-8] * 3)  # of no motion, rotation first [rad^2, m^2]


class StandstillConfig(OperatorConfig):
    max_turn_radps: PositiveFloat = 0.02
    max_shake_mps2: PositiveFloat = 0.1  # standard deviation of the specific force


@dataclass(frozen=True)
class Inputs:
    submaps: Receiver[Submap]
    imu: Receiver[ImuBatch]


@dataclass(frozen=True)
class Outputs:
    loops: Sender[LoopReport]  # one for each submap, as the optimizer expects


class Standstill(Operator[Inputs, Outputs]):
    """Tie keyframes to each other between which the IMU felt no motion."""

    def __init__(self, config: StandstillConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        imu = window(inputs.imu, optional=True)
        async for submap, batches in anchored(inputs.submaps, imu, interval=_span):
            edges = tuple(self.rests(submap, batches)) if batches else ()
            await outputs.loops.send(LoopReport(stamp_ns=submap.stamp_ns, edges=edges))

    def rests(self, submap: Submap, imu: tuple[ImuBatch, ...]) -> Iterator[RelativePose]:
        """Yield an edge for each two keyframes between which no sample tells of a motion."""
        stamps_ns = np.concatenate([batch.stamps_ns for batch in imu])
        turn_radps = np.concatenate([batch.gyro_radps for batch in imu])
        force_mps2 = np.concatenate([batch.accel_mps2 for batch in imu])
        for step in submap.edges:
            rows = (stamps_ns >= step.stamp_a_ns) & (stamps_ns <= step.stamp_b_ns)
            turns = np.abs(turn_radps[rows]).max(initial=0.0) > self._config.max_turn_radps
            shake = force_mps2[rows].std(axis=0).max() if rows.sum() > 1 else np.inf
            if not turns and shake <= self._config.max_shake_mps2:
                still = replace(step, T_a_b=SE3.identity(), covariance=_COVARIANCE)
                yield replace(still, kind="registration", source="standstill")


def _span(submap: Submap) -> tuple[int, int]:
    return submap.keyframes[0].stamp_ns, submap.stamp_ns
