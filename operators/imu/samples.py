"""Samples of an IMU: put together, cut, and judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import so3_exp
from mapstream.streams.messages.sensors import ImuBatch

_BLOCK_S = 0.25
_REST_RADPS, _REST_MPS2 = 0.01, 0.1  # how far means of blocks spread at rest


def joined(batches: Sequence[ImuBatch]) -> ImuBatch:
    """Return batches as one; what comes a second time, or late, is left out.

    Raises:
        ValueError: If there is no batch.
    """
    stamps_ns = np.concatenate([batch.stamps_ns for batch in batches])
    newest = np.maximum.accumulate(stamps_ns)
    kept = np.append(True, stamps_ns[1:] > newest[:-1])
    return ImuBatch(
        stamps_ns=stamps_ns[kept],
        gyro_radps=np.concatenate([batch.gyro_radps for batch in batches])[kept],
        accel_mps2=np.concatenate([batch.accel_mps2 for batch in batches])[kept],
        frame=batches[-1].frame,
        T_base_sensor=batches[-1].T_base_sensor,
    )


def cut(batch: ImuBatch, start_ns: int) -> ImuBatch:
    """Return the samples from a stamp on; it lies before the last one."""
    if batch.stamps_ns[0] >= start_ns:
        return batch
    kept = batch.stamps_ns >= start_ns
    return ImuBatch(
        stamps_ns=batch.stamps_ns[kept],
        gyro_radps=batch.gyro_radps[kept],
        accel_mps2=batch.accel_mps2[kept],
        frame=batch.frame,
        T_base_sensor=batch.T_base_sensor,
    )


def is_at_rest(samples: ImuBatch) -> bool:
    """Return whether rates and forces are the same throughout: their means over quarters of a second."""
    block = (samples.stamps_ns - samples.stamps_ns[0]) // round(_BLOCK_S * 1e9)
    _, first, counts = np.unique(block, return_index=True, return_counts=True)
    is_whole = counts > counts.max() / 2  # the last one may be short, and its mean worth little
    spreads = [
        np.ptp((np.add.reduceat(each, first) / counts[:, None])[is_whole], axis=0).max()
        for each in (samples.gyro_radps, samples.accel_mps2)
    ]
    return bool(spreads[0] < 2 * _REST_RADPS and spreads[1] < 2 * _REST_MPS2)


def level_attitude(up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that turns a direction (3,) to z by the shortest way."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(np.arctan2(sine, up[2]) / sine * axis)
