"""Odometry of holonomic wheels, which roll a little wrong always, and slip now and then."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert, se3_exp, se3_log
from mapstream.streams.messages.sensors import WheelOdometry

_SLIPS_PER_M = 0.1
_SLIP_S = 0.4  # how long the wheels turn without grip
_ASIDE = 2.0  # rollers slip more across the robot than along it


def wheel_odometry(
    poses: FloatArray, stamps_ns: IntArray, slip: float, rng: np.random.Generator
) -> Iterator[WheelOdometry]:
    """Yield the pose (N, 4, 4) that wheels believe in.

    Ways and turns are stretched by fixed factors of about `slip`, and steps are noisy.
    About every ten metres the wheels lose their grip for a moment, and count up to twice the way.
    """
    steps = se3_log(invert(poses[:-1]) @ poses[1:])
    lengths = np.linalg.norm(steps[:, 3:], axis=1)
    stretch = 1 + slip * rng.normal(size=3) * [1.0, 1.0, _ASIDE]  # of turns, x, y
    steps[:, [2, 3, 4]] *= stretch * (1 + _lost_grip(lengths, stamps_ns, slip, rng))[:, None]
    noise = slip * np.sqrt(lengths)[:, None] * rng.normal(size=(len(steps), 3))
    steps[:, [2, 3, 4]] += noise * [0.2, 0.2, 0.2]
    T = np.eye(4)
    yield WheelOdometry(stamp_ns=int(stamps_ns[0]), T_odom_base=SE3(T))
    for stamp_ns, step in zip(stamps_ns[1:].tolist(), se3_exp(steps), strict=True):
        T = T @ step
        yield WheelOdometry(stamp_ns=stamp_ns, T_odom_base=SE3(T))


def _lost_grip(
    lengths_m: FloatArray, stamps_ns: IntArray, slip: float, rng: np.random.Generator
) -> FloatArray:
    """Return how much more than they roll the wheels count, for each step (N,); mostly nothing."""
    excess = np.zeros(len(lengths_m))
    num = int(slip > 0) * rng.poisson(_SLIPS_PER_M * lengths_m.sum())
    for start in rng.integers(0, len(lengths_m), num):
        end = np.searchsorted(stamps_ns, stamps_ns[start] + round(_SLIP_S * 1e9))
        excess[start:end] = rng.uniform(0.2, 1.0)
    return excess
