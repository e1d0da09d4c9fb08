"""The motion of W-RGBD: a camera in the hand goes round a table, looks round the room, and at the table again."""

from __future__ import annotations

import numpy as np

from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.sway import RAMP_S, REST_S, from_rest, smooth, waves

_REACH_M = (1.75, 1.45)  # of the way round the table
_HEIGHT_M = 1.35
_AWAY = ((0.36, 0.44), (0.62, 0.70))  # shares of the way: turns away from the table, and back
_DOWN_RAD, _LEVEL_RAD = 0.42, 0.05  # the pitch towards the table, and towards the walls
_LAPS = 1.25
_ASIDE_RAD = 1.7  # from the table to the walls, ahead
_SWAY = ((0.04, 0.03, 0.06), (0.43, 0.37, 0.53))  # amplitudes [m] and rates [Hz] of three axes
_SWAY_RPY = ((0.04, 0.03, 0.06), (0.41, 0.61, 0.29))  # [rad]


def orbit(duration_s: float, start_ns: int) -> Motion:
    """Return T_world_base, from rest: x is where the camera looks, z upwards."""
    start = from_rest(duration_s, start_ns)
    share = start.moved_s / max(duration_s - REST_S - RAMP_S / 2, 1.0)
    (leaves, left), (returns, back) = _AWAY
    away = smooth((share - leaves) / (left - leaves)) - smooth((share - returns) / (back - returns))
    angle = 2 * np.pi * _LAPS * share
    x, y = _REACH_M[0] * np.cos(angle), _REACH_M[1] * np.sin(angle)
    positions = np.stack([x, y, np.full_like(x, _HEIGHT_M)], axis=1)
    heading = np.unwrap(np.arctan2(-y, -x)) - _ASIDE_RAD * away
    pitch = _DOWN_RAD + (_LEVEL_RAD - _DOWN_RAD) * away
    rpy_rad = np.stack([np.zeros_like(x), pitch, heading], axis=1)
    positions += start.amount[:, None] * waves(start.t_s, *_SWAY)
    rpy_rad += start.amount[:, None] * waves(start.t_s, *_SWAY_RPY)
    return Motion(start.stamps_ns, positions, rpy_rad)
