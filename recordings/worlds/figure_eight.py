"""The motion of W-VI: a figure of eight in the air, as of a small drone or a camera in the hand."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveFloat

from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.sway import RAMP_S, REST_S, from_rest, smooth, waves
from mapstream.streams.arrays import FloatArray

_LENGTH_M, _WIDTH_M = 5.5, 3.0  # half of the eight's
_HEIGHT_M = 1.5
_TURN_RAD = 0.8  # of the phase, for the half turn between two laps
_SPIN_RADPS = 0.6
# Slow and fast: amplitudes and rates [Hz] of three axes.
_SWAY = (
    ((0.20, 0.15, 0.30), (0.071, 0.083, 0.113)),  # [m]
    ((0.02, 0.02, 0.04), (0.97, 1.13, 0.89)),
)
_SWAY_RPY = (
    ((0.06, 0.07, 0.12), (0.31, 0.37, 0.23)),  # [rad]
    ((0.025, 0.025, 0.02), (1.27, 1.07, 0.83)),
)


class FlightConfig(BaseModel):
    """How the robot moves."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    duration_s: PositiveFloat = 60.0
    lap_s: PositiveFloat = 28.0
    """Once round the eight, 32 m."""
    kind: Literal["eight", "turn", "stand"] = "eight"
    """`turn`: rotation on the spot."""
    start: Literal["rest", "moving"] = "rest"
    """Two seconds at rest, or in full motion from the first sample."""
    phase_rad: float = 0.0
    """Where on the eight it starts."""
    turn_back: bool = False
    """Fly the second lap backwards: the rear cameras look where the front ones looked."""


def eight(phase_rad: FloatArray) -> FloatArray:
    """Return points (N, 2) [m] of the eight (Gerono's lemniscate)."""
    return np.stack([_LENGTH_M * np.sin(phase_rad), _WIDTH_M * np.sin(2 * phase_rad)], axis=1)


def flight(config: FlightConfig, start_ns: int) -> Motion:
    """Return T_world_base: x is ahead, z upwards."""
    skip_s = 0.0 if config.start == "rest" else REST_S + RAMP_S
    start = from_rest(config.duration_s, start_ns, skip_s=skip_s)
    moved_s, sway = start.moved_s, start.amount[:, None]
    if config.kind == "stand":
        moved_s, sway = np.zeros_like(moved_s), np.zeros_like(sway)
    lap_rad = 2 * np.pi / config.lap_s * moved_s
    phase = config.phase_rad + (lap_rad if config.kind == "eight" else np.zeros_like(moved_s))
    heading = _headings(phase)
    if config.kind == "turn":
        heading = heading + _SPIN_RADPS * moved_s
    if config.turn_back:
        heading = heading + np.pi * smooth((lap_rad - 2 * np.pi) / _TURN_RAD)
    positions = np.concatenate([eight(phase), np.full((len(phase), 1), _HEIGHT_M)], axis=1)
    if config.kind == "eight":
        positions += sway * sum(waves(start.t_s, *wave) for wave in _SWAY)
    rpy_rad = sway * sum(waves(start.t_s, *wave) for wave in _SWAY_RPY)
    rpy_rad[:, 2] += heading
    return Motion(start.stamps_ns, positions, rpy_rad)


def _headings(phase_rad: FloatArray) -> FloatArray:
    """Return the directions (N,) [rad] in which the eight runs."""
    along = _LENGTH_M * np.cos(phase_rad), 2 * _WIDTH_M * np.cos(2 * phase_rad)
    return np.unwrap(np.arctan2(along[1], along[0]))
