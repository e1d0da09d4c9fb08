"""The way of a holonomic robot round a ring of corridors, in and out of the rooms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.office import CORE_M, CORRIDOR_M, Office, Room
from mapstream.recordings.worlds.sway import RAMP_S, REST_S, from_rest
from mapstream.recordings.worlds.way import STEP_M, smoothed
from mapstream.streams.arrays import FloatArray

_ROUND_M, _TURN_M = 0.35, 0.5  # standard deviations that smooth the way, and the headings along it
_SWAY_M, _SWAY_RAD = 0.06, 0.12
_STATION = tuple[float, float, float]  # x, y [m], heading [rad]


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """What a robot is to do."""

    laps: float
    visits: bool  # drive into every room in the first lap
    is_reverse: bool  # from the end to the start
    speed_mps: float


def office_drive(floor: Office, route: Route, start_ns: int, rng: np.random.Generator) -> Motion:
    """Return T_world_base: from rest amid the southern corridor, counterclockwise unless it is reversed.

    Corners and turns are rounded, so that the robot slows down there by itself.
    """
    stations = np.array(list(_stations(floor, route, rng)))
    if route.is_reverse:
        stations = _reversed(stations)
    legs = np.linalg.norm(np.diff(stations[:, :2], axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(legs)])
    way = np.arange(0.0, reached[-1], STEP_M)
    x, y = (smoothed(np.interp(way, reached, stations[:, k]), _ROUND_M) for k in (0, 1))
    heading = smoothed(np.interp(way, reached, stations[:, 2]), _TURN_M)
    start = from_rest(way[-1] / route.speed_mps + REST_S + RAMP_S / 2, start_ns)
    at = np.clip(start.moved_s * route.speed_mps, 0.0, way[-1])
    phases = rng.uniform(0, 2 * np.pi, 2)
    aside = _SWAY_M * start.amount * np.sin(at / 1.9 + phases[0])
    turn = np.interp(at, way, heading)
    across = turn + np.pi / 2
    position = np.stack(
        [
            np.interp(at, way, x) + aside * np.cos(across),
            np.interp(at, way, y) + aside * np.sin(across),
            np.zeros_like(at),
        ],
        axis=1,
    )
    rpy_rad = np.zeros_like(position)
    rpy_rad[:, 2] = turn + _SWAY_RAD * start.amount * np.sin(at / 2.7 + phases[1])
    return Motion(start.stamps_ns, position, rpy_rad)


def _stations(floor: Office, route: Route, rng: np.random.Generator) -> Iterator[_STATION]:
    """Yield where the way goes, in straight lines; the last lap may be a part of one."""
    right = (floor.width_m - CORRIDOR_M) / 2
    left, south, north = -right, 0.0, CORE_M + CORRIDOR_M
    middle = 0.0
    length = 2 * (right - left + north - south)
    corners = ((right, south), (right, north), (left, north), (left, south), (middle, south))
    at, heading = (middle, south), 0.0
    yield *at, heading
    for lap in range(int(np.ceil(route.laps))):
        left_m = min(1.0, route.laps - lap) * length
        for corner in corners:
            leg = float(np.hypot(corner[0] - at[0], corner[1] - at[1]))
            share = min(1.0, left_m / leg)
            if share <= 0:
                return
            end = (at[0] + share * (corner[0] - at[0]), at[1] + share * (corner[1] - at[1]))
            for room in _on_the_way(floor, at, end) if route.visits and lap == 0 else []:
                yield from _visit(room, heading, rng)
            yield *end, heading
            left_m -= leg
            at, heading = end, heading + (np.pi / 2 if corner != corners[-1] else 0.0)


def _on_the_way(floor: Office, start: tuple[float, float], end: tuple[float, float]) -> list[Room]:
    """Return the rooms with a door on a leg along x, in the order in which they are passed."""
    low, high = sorted((start[0], end[0]))
    is_east = end[0] > start[0]
    passed = [
        room
        for room in floor.rooms
        if start[1] == end[1] and abs(room.corridor_m - end[1]) < 1e-9 and low < room.door_m < high
    ]
    return sorted(passed, key=lambda room: room.door_m, reverse=not is_east)


def _visit(room: Room, heading: float, rng: np.random.Generator) -> Iterator[_STATION]:
    """Yield the way to the middle of a room and back; the robot looks to one side, then to the other."""
    middle = sum(room.y_m) / 2
    turn = rng.choice([-1, 1]) * rng.uniform(0.8, 1.5)
    yield room.door_m, room.corridor_m, heading
    yield room.door_m, room.wall_m, heading + turn / 2
    yield room.door_m, middle, heading + turn
    yield room.door_m, room.wall_m, heading - turn
    yield room.door_m, room.corridor_m, heading


def _reversed(stations: FloatArray) -> FloatArray:
    """Return the stations from the last to the first, facing the other way."""
    back = stations[::-1].copy()
    back[:, 2] += np.pi - back[0, 2]
    return back
