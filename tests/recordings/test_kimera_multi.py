"""Measurements of robot teams become missions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.kimera_multi import HEADER, read_kimera_multi
from mapstream.recordings.maps import check_map
from mapstream.streams.errors import RecordingError
from tests.data import shared


def write_team(folder: Path, lines: dict[int, list[str]]) -> None:
    for robot, rows in lines.items():
        (folder / f"robot{robot}").mkdir(parents=True)
        text = "\n".join([HEADER, *rows])
        (folder / f"robot{robot}" / "measurements.csv").write_text(text)


def step(a: str, b: str, x_m: float, *, is_known: int = 1, weight: float = 1.0) -> str:
    return f"{a},{b},0,0,0,1,{x_m},0,0,10000,100,{is_known},{weight}"


def test_S3_eight_real_robots_are_eight_missions() -> None:
    """5.9 km of eight robots, 3644 loops, those between two robots in the files of both."""
    map_ = read_kimera_multi(shared("kimera_multi_tunnels"))

    rows = [map_.vertices_of(row) for row in range(len(map_.missions))]
    assert len(rows) == 8
    assert map_.missions.is_base_frame_known.tolist() == [True, *[False] * 7]
    assert len(map_.edges_of("odometry")) == 1247
    assert len(map_.edges_of("loop")) == 3644
    np.testing.assert_array_equal(map_.edges.is_switchable, map_.edges.kind == "loop")
    steps = [np.diff(map_.vertices.T_mission_base[each, :3, 3], axis=0) for each in rows]
    assert sum(np.linalg.norm(each, axis=1).sum() for each in steps) == pytest.approx(5915, abs=1)
    assert check_map(map_) == []


def test_a_loop_in_both_files_counts_once_and_precisions_are_those_of_se_sync(
    tmp_path: Path,
) -> None:
    first, again = (step("0,1", "1,0", 3, is_known=0, weight=w) for w in (0.0, 0.5))
    write_team(
        tmp_path / "team",
        {0: [step("0,0", "0,1", 1), first], 1: [step("1,0", "1,1", 2), again]},
    )

    map_ = read_kimera_multi(tmp_path / "team")

    assert map_.missions.name.tolist() == ["team/robot0", "team/robot1"]
    assert map_.edges.kind.tolist() == ["odometry", "loop", "odometry"]
    assert map_.vertices.T_mission_base[:, 0, 3].tolist() == [0, 1, 0, 2]
    variances = np.diagonal(map_.edges.covariance[0])
    np.testing.assert_allclose(variances, [5e-5] * 3 + [0.01] * 3)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0,0,0,1,0,0,0", "line 2: could not broadcast"),
        ("0,0,0,1,0,0,0,0,1,0,0,10000,100,1,1", "line 2: expected finite numbers, a rotation"),
        ("0,0,0,1,0,0,0,x,1,0,0,10000,100,1,1", "line 2: could not convert"),
        ("0,-1,0,1,0,0,0,1,1,0,0,10000,100,1,1", "line 2: expected whole numbers"),
    ],
)
def test_damaged_lines_are_named(line: str, message: str, tmp_path: Path) -> None:
    write_team(tmp_path, {0: [line]})

    with pytest.raises(RecordingError, match=message):
        read_kimera_multi(tmp_path)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()

    with pytest.raises(RecordingError, match=r"expected robot0/measurements\.csv .* found images"):
        read_kimera_multi(tmp_path)
