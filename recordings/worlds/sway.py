"""What motions of hands and small drones share: they begin at rest, and are never quite steady."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray

_KNOT_NS = 50_000_000
_MARGIN = 3  # knots beyond both ends
REST_S = 2.0
RAMP_S = 2.0  # from rest to full speed

Axes = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A motion's knots, and how much of it there is at each."""

    stamps_ns: IntArray  # (N,) beyond both ends of the recording
    t_s: FloatArray  # (N,) since the start
    moved_s: FloatArray  # (N,) time that a motion of full speed would have taken
    amount: FloatArray  # (N,) 0 at rest, 1 in full motion


def from_rest(duration_s: float, start_ns: int, *, skip_s: float = 0.0) -> Start:
    """Return the knots of a motion that begins at rest, or `skip_s` later."""
    num_knots = round(duration_s * 1e9) // _KNOT_NS + 2
    stamps_ns = start_ns + np.arange(-_MARGIN, num_knots + _MARGIN) * _KNOT_NS
    t_s = (stamps_ns - start_ns) / 1e9 + skip_s
    ramp = np.clip((t_s - REST_S) / RAMP_S, 0, 1)
    moved_s = RAMP_S * (ramp**3 - ramp**4 / 2) + np.maximum(0, t_s - REST_S - RAMP_S)
    return Start(stamps_ns, t_s, moved_s, smooth(ramp))


def smooth(share: FloatArray) -> FloatArray:
    """Return a way from 0 to 1 that begins and ends without speed; shares beyond are clipped."""
    share = np.clip(share, 0, 1)
    way: FloatArray = share * share * (3 - 2 * share)
    return way


def waves(t_s: FloatArray, amplitudes: Axes, rates_hz: Axes) -> FloatArray:
    """Return a sine wave (N, 3) per axis; rates without a common measure never repeat."""
    wave: FloatArray = np.array(amplitudes) * np.sin(2 * np.pi * t_s[:, None] * np.array(rates_hz))
    return wave
