"""The motion of W-VI: a figure of eight in the air, as of a small drone or a camera in the hand."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveFloat

from mapstream.recordings.worlds.motion import Motion
from mapstream.streams.arrays import FloatArray

_LENGTH_M, _WIDTH_M = 5.5, 3.0  # half of the eight's
_HEIGHT_M = 1.5
_KNOT_NS = 50_000_000
_MARGIN = 3  # knots beyond both ends
_REST_S = 2.0
_RAMP_S = 2.0  # from rest to full speed
_TURN_RAD = 0.8  # of the phase, for the half turn between two laps
_SPIN_RADPS = 0.6
_Waves = tuple[tuple[float, float, float], tuple[float, float, float]]  # slow and fast, three axes
_SWAY_M: _Waves = ((0.20, 0.15, 0.30), (0.02, 0.02, 0.04))
_SWAY_HZ: _Waves = ((0.071, 0.083, 0.113), (0.97, 1.13, 0.89))
_SWAY_RAD: _Waves = ((0.06, 0.07, 0.12), (0.025, 0.025, 0.02))
_SWAY_RAD_HZ: _Waves = ((0.31, 0.37, 0.23), (1.27, 1.07, 0.83))


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
    num_knots = round(config.duration_s * 1e9) // _KNOT_NS + 2
    stamps_ns = start_ns + np.arange(-_MARGIN, num_knots + _MARGIN) * _KNOT_NS
    t_s = (stamps_ns - start_ns) / 1e9 + (0.0 if config.start == "rest" else _REST_S + _RAMP_S)
    ramp = np.clip((t_s - _REST_S) / _RAMP_S, 0, 1)
    moved_s = _RAMP_S * (ramp**3 - ramp**4 / 2) + np.maximum(0, t_s - _REST_S - _RAMP_S)
    sway = _smooth(ramp)
    if config.kind == "stand":
        moved_s, sway = np.zeros_like(t_s), np.zeros_like(t_s)
    lap_rad = 2 * np.pi / config.lap_s * moved_s
    phase = config.phase_rad + (lap_rad if config.kind == "eight" else np.zeros_like(t_s))
    heading = _headings(phase)
    if config.kind == "turn":
        heading = heading + _SPIN_RADPS * moved_s
    if config.turn_back:
        heading = heading + np.pi * _smooth(np.clip((lap_rad - 2 * np.pi) / _TURN_RAD, 0, 1))
    positions = np.concatenate([eight(phase), np.full((len(t_s), 1), _HEIGHT_M)], axis=1)
    if config.kind == "eight":
        positions += sway[:, None] * _waves(t_s, _SWAY_M, _SWAY_HZ)
    rpy_rad = sway[:, None] * _waves(t_s, _SWAY_RAD, _SWAY_RAD_HZ)
    rpy_rad[:, 2] += heading
    return Motion(stamps_ns, positions, rpy_rad)


def _smooth(share: FloatArray) -> FloatArray:
    """Return a way from 0 to 1 that begins and ends without speed."""
    way: FloatArray = share * share * (3 - 2 * share)
    return way


def _headings(phase_rad: FloatArray) -> FloatArray:
    """Return the directions (N,) [rad] in which the eight runs."""
    along = _LENGTH_M * np.cos(phase_rad), 2 * _WIDTH_M * np.cos(2 * phase_rad)
    return np.unwrap(np.arctan2(along[1], along[0]))


def _waves(t_s: FloatArray, amplitudes: _Waves, rates_hz: _Waves) -> FloatArray:
    """Return sums of two sine waves (N, 3) whose rates have no common measure: no lap is like another."""
    turns = 2 * np.pi * t_s[:, None, None] * np.array(rates_hz)
    waves: FloatArray = (np.array(amplitudes) * np.sin(turns)).sum(axis=1)
    return waves
