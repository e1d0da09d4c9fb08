"""A robot in a grid or a map that was made before: found from anywhere, followed, and found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.floor import grid_surface, open_floor
from mapstream.operators.laser.grid_localization import GridLocalization, GridLocalizationConfig
from mapstream.operators.laser.odds_grid import OddsConfig, OddsGrid
from mapstream.operators.laser.sight import rays_of
from mapstream.operators.testing import run_operator
from mapstream.recordings.grid_files import write_grid
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.streams.errors import MapError, RecordingError
from mapstream.streams.messages.estimates import MapPose, Odometry
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapstream.streams.messages.sensors import LaserScan2D, WheelOdometry
from mapstream.streams.trajectory import Trajectory

pytestmark = pytest.mark.anyio
RUN: dict[str, Any] = {
    "width_m": 14.0,
    "wheels_hz": 20.0,
    "laser": {"beams": 181, "rate_hz": 4.0},
    "building_seed": 0,
}
SECOND_NS = 10**9


class Run:
    """What one drive recorded."""

    def __init__(self, seed: int, **options: Any) -> None:  # noqa: ANN401  # of the world
        config = W2dConfig.model_validate(RUN | options)
        messages = [record.message for record in w_2d(config, seed).records]
        self.scans = [m for m in messages if isinstance(m, LaserScan2D)]
        self.wheels = [m for m in messages if isinstance(m, WheelOdometry)]
        truth = [m for m in messages if isinstance(m, Odometry)]
        self.way = Trajectory(
            stamps_ns=np.array([m.stamp_ns for m in truth]),
            poses=np.array([m.T_odom_base.matrix for m in truth]),
        )

    def errors_m(self, poses: list[MapPose]) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return how far the poses that were found are from the truth."""
        found = [pose for pose in poses if pose.T_map_base is not None]
        at = self.way.at(np.array([pose.stamp_ns for pose in found]))
        places = np.array([pose.T_map_base.matrix for pose in found if pose.T_map_base])
        off: np.ndarray[Any, np.dtype[np.float64]] = np.linalg.norm((places - at)[:, :2, 3], axis=1)
        return off


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The grid of a first drive, at its true poses."""
    path = tmp_path_factory.mktemp("floor") / "plan.yaml"
    first, odds = Run(0, laps=1, visits=False), OddsGrid(OddsConfig())
    for scan in first.scans[::2]:
        if first.way.covers(scan.end_ns):
            T = first.way.pose_at(scan.end_ns).matrix
            points = beam_ends(scan, first.way).points
            odds.add(rays_of(points, scan.T_base_sensor.t, T, (0.1, 1.5), 20.0))
    write_grid(path, odds.grid(0))
    return path


@pytest.fixture(scope="module")
def second() -> Run:
    """A drive through the same building on another day, the other way round."""
    return Run(1, laps=0.45, visits=False, is_reverse=True)


@pytest.mark.slow
async def test_N12_a_second_run_is_found_and_followed(plan: Path, second: Run) -> None:
    """Nobody says where it starts; errors are below 5 cm, and it is never lost again."""
    operator = GridLocalization(GridLocalizationConfig(map=plan))

    out = await run_operator(operator, laser=second.scans, wheels=second.wheels)

    states = [pose.state for pose in out["poses"]]
    first = states.index("tracking")
    assert first < 0.4 * len(states)  # it rests for the first two of twenty seconds
    assert set(states[first:]) == {"tracking"}
    errors_m = second.errors_m(out["poses"])
    assert np.sqrt(np.mean(errors_m**2)) < 0.035
    assert np.quantile(errors_m, 0.95) < 0.05
    assert len(out["odometry"]) == len(errors_m)


@pytest.mark.slow
async def test_N12_a_robot_that_is_carried_elsewhere_is_found_again(
    plan: Path, second: Run
) -> None:
    """For six seconds nothing is recorded, and the wheels know nothing of the way in that time.

    It is put down in a corridor that looks like another one, which must not be believed.
    """
    start, end = second.scans[0].stamp_ns, second.scans[-1].stamp_ns
    lifted_ns = start + (end - start) // 4
    put_down_ns = lifted_ns + 5 * SECOND_NS
    before = next(m for m in reversed(second.wheels) if m.stamp_ns <= lifted_ns)
    after = next(m for m in second.wheels if m.stamp_ns >= put_down_ns)
    jump = before.T_odom_base @ after.T_odom_base.inverse()
    wheels = [m for m in second.wheels if m.stamp_ns <= lifted_ns] + [
        replace(m, T_odom_base=jump @ m.T_odom_base)
        for m in second.wheels
        if m.stamp_ns >= put_down_ns
    ]
    scans = [m for m in second.scans if not lifted_ns - SECOND_NS < m.stamp_ns < put_down_ns]
    x, y = second.way.pose_at(scans[0].end_ns).t[:2].tolist()
    config = GridLocalizationConfig(map=plan, start=(x + 0.1, y, np.pi), max_misfits=4)

    out = await run_operator(GridLocalization(config), laser=scans, wheels=wheels)

    states = [pose.state for pose in out["poses"]]
    is_later = [pose.stamp_ns > put_down_ns for pose in out["poses"]]
    at = is_later.index(True)
    assert set(states[4:at]) == {"tracking"}
    assert "lost" in states[at:]
    assert "recovered" in states[at:]
    assert second.errors_m(out["poses"][at + states[at:].index("lost") :]).max() < 0.06
    assert set(states[-6:]) == {"tracking"}


def cells(*rows: str) -> OccupancyGrid:
    """Return a grid of `#` occupied, `.` free and blanks unknown; the first row is the upper one."""
    value = {"#": OCCUPIED, ".": FREE, " ": UNKNOWN}
    table = np.array([[value[c] for c in row] for row in reversed(rows)], np.int8)
    return OccupancyGrid(stamp_ns=0, cells=table, resolution_m=0.1)


def test_walls_of_a_grid_face_the_free_space() -> None:
    surface = grid_surface(cells("      ", "######", "......", "......", "######"))

    upper = surface.points[:, 1] > 0.2
    np.testing.assert_allclose(surface.points[upper, 1], 0.35)
    np.testing.assert_allclose(surface.normals[upper][2:4], [[0, -1]] * 2, atol=0.2)
    np.testing.assert_allclose(surface.normals[~upper][2:4], [[0, 1]] * 2, atol=0.2)


def test_refuses_a_floor_without_walls(tmp_path: Path) -> None:
    write_grid(tmp_path / "a.yaml", cells("....", "...#"))

    with pytest.raises(MapError, match="1 points on walls are too few"):
        open_floor(tmp_path / "a.yaml")
    with pytest.raises(RecordingError, match="no grid can be read"):
        open_floor(tmp_path / "b.yaml")
