"""Ways through the building of W-MR: eleven, each from a room of its own to the next one and back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle

import numpy as np

from mapstream.recordings.worlds.building_plan import Room
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.sway import Axes, Start, from_rest, waves
from mapstream.recordings.worlds.way import STEP_M, smoothed
from mapstream.streams.arrays import FloatArray

NUM_WAYS = 11
CARRIED_M = 1.4  # height of what is carried in the hand
_AROUND_M = (1.45, 1.2)  # from the middle of a room, on the way round its table
_ENTRY_M = 0.75  # from a wall with a door, inside
_ROUND_M, _TURN_M = 0.3, 0.4  # standard deviations that smooth the way, and the headings along it
_Waves = Sequence[tuple[Axes, Axes]]  # amplitudes and rates [Hz] of three axes
_HAND: _Waves = (
    ((0.08, 0.06, 0.10), (0.23, 0.31, 0.37)),  # [m]
    ((0.012, 0.012, 0.02), (0.97, 1.13, 1.71)),
)
_HAND_RPY: _Waves = (
    ((0.04, 0.05, 0.10), (0.31, 0.37, 0.17)),  # [rad]
    ((0.015, 0.015, 0.015), (1.27, 1.07, 0.83)),
)
_WHEELS: _Waves = (((0.0, 0.0, 0.002), (1.0, 1.0, 1.7)),)
_WHEELS_RPY: _Waves = (((0.003, 0.003, 0.06), (0.9, 1.3, 0.13)),)


def tour(
    rooms: Sequence[Room],
    number: int,
    duration_s: float,
    speed_mps: float,
    start_ns: int,
    *,
    is_carried: bool,
) -> Motion:
    """Return T_world_base of a way: x is ahead, z upwards; on the floor unless it is carried.

    The first six ways begin in one room each and go on to the next one, in one sense of rotation; the others in the
    opposite one. A way that is longer than a visit to two rooms comes back to the first.
    """
    start = from_rest(duration_s, start_ns)
    at = start.moved_s * speed_mps
    stations = np.array(list(_stations(rooms, number, at[-1] + 2.0)))
    legs = np.linalg.norm(np.diff(stations, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(legs)])
    way = np.arange(0.0, reached[-1], STEP_M)
    x, y = (smoothed(np.interp(way, reached, axis), _ROUND_M) for axis in stations.T)
    heading = smoothed(np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))), _TURN_M)
    height = np.full_like(at, CARRIED_M if is_carried else 0.0)
    positions = np.stack([np.interp(at, way, x), np.interp(at, way, y), height], axis=1)
    rpy_rad = np.zeros_like(positions)
    rpy_rad[:, 2] = np.interp(at, way, heading)
    positions += _swayed(start, _HAND if is_carried else _WHEELS)
    rpy_rad += _swayed(start, _HAND_RPY if is_carried else _WHEELS_RPY)
    return Motion(start.stamps_ns, positions, rpy_rad)


def _swayed(start: Start, sway: _Waves) -> FloatArray:
    moved: FloatArray = start.amount[:, None] * sum(waves(start.t_s, *wave) for wave in sway)
    return moved


def _stations(rooms: Sequence[Room], number: int, length_m: float) -> Iterator[tuple[float, float]]:
    """Yield where a way goes in straight lines, from amid its first room until it is long enough."""
    sense = 1 if number < len(rooms) else -1
    first = rooms[number % len(rooms)]
    visited = (first, rooms[(first.number + sense) % len(rooms)])
    stations = [spot for room in visited for spot in _visit(room, sense)]
    last, left_m = None, length_m
    for row, spot in enumerate(cycle(stations)):
        if row < 3:  # before the far side of the first room
            continue
        left_m -= 0.0 if last is None else float(np.hypot(spot[0] - last[0], spot[1] - last[1]))
        yield spot
        if left_m < 0:
            return
        last = spot


def _visit(room: Room, sense: int) -> list[tuple[float, float]]:
    """Return the way from the corridor round the table of a room, and back."""
    (x, y), (wide, deep) = room.middle_m, _AROUND_M
    wall = room.low_m[1] if room.side > 0 else room.high_m[1]
    entry = (room.door_m, wall + room.side * _ENTRY_M)
    near, far = y - room.side * deep, y + room.side * deep
    left, right = x - sense * wide, x + sense * wide
    loop = [(left, near), (left, far), (right, far), (right, near)]
    return [(room.door_m, 0.0), entry, *loop, entry, (room.door_m, 0.0)]
