"""Where a robot may be on a floor, and whether that is the only place."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, pairwise

import numpy as np
import pytest

from mapstream.operators.laser.correlative import LikelihoodGrid, Window
from mapstream.operators.laser.floor import Floor
from mapstream.operators.laser.floor_search import FloorSearch, FloorSearchConfig, View
from mapstream.operators.laser.matching import ScanMatch
from mapstream.operators.laser.planar import difference, flattened, lifted
from mapstream.operators.laser.surfaces import Surface, surface_of
from mapstream.operators.laser.walls import Walls
from mapstream.streams.arrays import FloatArray

ROOM = [(0, 0), (6, 0), (6, 4), (0, 4), (0, 0)]
WITH_ALCOVE = [(0, 0), (6, 0), (6, 4), (2, 4), (2, 3), (0, 3), (0, 0)]
START = np.array([4.5, 1.5, 0.4])


def outline(corners: Sequence[tuple[float, float]]) -> FloatArray:
    """Return points (N, 2) along a closed line, 4 cm apart."""
    parts = [
        np.linspace(a, b, round(float(np.hypot(*np.subtract(b, a))) / 0.04), endpoint=False)
        for a, b in pairwise(corners)
    ]
    return np.concatenate(parts)


def room(corners: Sequence[tuple[float, float]]) -> Surface:
    """Return the walls, as a robot sees them that stands where all of them are in sight."""
    return surface_of(outline(corners), START[:2])


def found(corners: Sequence[tuple[float, float]]) -> ScanMatch | None:
    """Return what comes of driving a metre and a half, with odometry that began elsewhere."""
    walls = room(corners)
    search = FloorSearch(Floor(walls), FloorSearchConfig())
    for step, way_m in enumerate(np.arange(0.0, 1.6, 0.35)):
        pose = START - [way_m, 0.0, 0.0]
        seen = walls.moved(flattened(lifted(pose).inverse()))
        odometry = flattened(lifted(np.array([9.0, 9.0, 2.0])) @ lifted(pose))
        match = search.find(step * 10**9, View(seen, np.zeros(2), odometry))
        if match is not None:
            assert np.abs(difference(match.pose, pose)).max() < 0.02
            return match
    return None


def test_N12_a_place_is_believed_if_there_is_no_other() -> None:
    assert found(WITH_ALCOVE) is not None


def test_N12_of_two_places_that_look_alike_none_is_believed() -> None:
    """Whoever turns round in the middle of a room with four bare walls sees the same."""
    assert found(ROOM) is None


def test_beams_that_pass_through_walls_are_seen() -> None:
    wall = np.stack([np.full(80, 2.0), np.linspace(-2, 2, 80)], axis=1)
    walls = Walls(surface_of(wall, np.zeros(2)), 0.05)
    beyond, on, before, beside = [4.0, 0.0], [2.1, 0.0], [1.0, 0.0], [4.0, 5.0]

    crossed = walls.crossed(np.array([beyond, on, before, beside]), np.zeros(2))

    assert crossed.tolist() == [True, False, False, False]
    along = walls.crossed(np.array([[2.05, 4.0]]), np.array([1.95, -4.0]))
    assert not along[0]  # by what the pose is off


@pytest.mark.parametrize("num", [1, 2, 4])
def test_basins_lie_apart_and_the_best_comes_first(num: int) -> None:
    grid = LikelihoodGrid(outline(ROOM), resolution_m=0.1, sigma_m=0.15)
    points = outline(ROOM)[::3] - [3.0, 2.0]
    window = Window(radius_m=2.0, turn_rad=np.pi, turn_step_rad=np.radians(5))

    basins = list(islice(grid.basins(points, np.array([3.0, 2.0, 0.0]), window), num))

    scores = [basin.score for basin in basins]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] > 0.95
    for at, basin in enumerate(basins):
        for other in basins[:at]:
            off = np.abs(difference(other.pose, basin.pose))
            assert off[1:].max() > 0.3 or off[0] > 0.24
