"""Loops from elsewhere go into a map between its vertices, and out again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.maps.loops import close_loops, delete_loops
from mapstream.operators.maps.merge import merge
from mapstream.operators.maps.residuals import chi2, relative_edges
from mapstream.recordings.loop_files import read_loops
from mapstream.recordings.maps import Map, check_map
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from mapstream.streams.trajectory import Trajectory
from tests.recordings.made_maps import COVARIANCE, MISSION, OTHER_MISSION, STEP_NS, line_map


def two_robots() -> Map:
    """Two robots on the same way."""
    return merge([line_map(6), line_map(4, OTHER_MISSION)])[0]


def loop(a_ns: int, b_ns: int, T_a_b: SE3, mission_b: str = OTHER_MISSION) -> RelativePose:
    return RelativePose(
        kind="loop",
        mission_a=MISSION[:4],
        stamp_a_ns=a_ns,
        mission_b=mission_b,
        stamp_b_ns=b_ns,
        T_a_b=T_a_b,
        covariance=COVARIANCE,
        is_switchable=True,
    )


def true_loop(map_: Map, a_ns: int, b_ns: int) -> RelativePose:
    """What an exact matcher measures between two instants."""
    ways = [map_.trajectory(mission) for mission in (MISSION, OTHER_MISSION)]
    assert all(isinstance(way, Trajectory) for way in ways)
    return loop(a_ns, b_ns, ways[0].pose_at(a_ns).inverse() @ ways[1].pose_at(b_ns))


def test_A15_a_loop_joins_the_nearest_vertices_and_its_motion_is_made_up_for() -> None:
    map_ = two_robots()
    measured = true_loop(map_, 1_000 + int(2.3 * STEP_NS), 1_000 + int(1.6 * STEP_NS))

    closed, report = close_loops(map_, [measured])

    [edge] = closed.edges_of("loop").tolist()
    assert (report.num_added, report.left_out) == (1, {})
    assert (closed.edges.vertex_a[edge], closed.edges.vertex_b[edge]) == (2, 6 + 2)
    np.testing.assert_allclose(chi2(closed, np.array([edge])), 0, atol=1e-12)
    assert check_map(closed) == []


def test_A15_loops_that_lead_nowhere_are_counted_by_the_reason() -> None:
    map_ = two_robots()
    strange = [loop(5, 5, SE3.identity()), loop(1_000, 1_001, SE3.identity(), MISSION)]

    closed, report = close_loops(map_, [*strange, loop(1_000, 1_000, SE3.identity(), "77")])

    assert report.num_added == 0
    assert sorted(text.split(" ")[0] for text in report.left_out) == ["5", "both", "no"]
    assert closed.digest() == map_.digest()


def test_H16_deleting_loops_leads_back_to_the_earlier_graph() -> None:
    """Twice optimised, with a loop and after it is gone, poses and chi2 are what they were."""
    map_ = two_robots()
    away = SE3.exp([0, 0, 0.1, 0.5, 0, 0])
    closed, _ = close_loops(map_, [loop(1_000, 1_000, away), loop(1_000 + STEP_NS, 1_000, away)])
    bent, _ = optimize_map(closed, OptimizeConfig(is_robust=False))
    assert np.abs(bent.vertices.T_mission_base - map_.vertices.T_mission_base).max() > 1e-3

    deleted, num = delete_loops(bent)
    again, _ = optimize_map(deleted, OptimizeConfig())

    assert num == 2
    rows = relative_edges(again)
    np.testing.assert_allclose(chi2(again, rows), chi2(map_, rows), atol=1e-9)
    assert deleted.edges.id.tolist() == map_.edges.id.tolist()


def test_H16_loops_are_deleted_by_kind_mission_and_source() -> None:
    map_, _ = close_loops(
        two_robots(),
        [
            loop(1_000, 1_000, SE3.identity()),
            replace(loop(1_000, 1_000 + STEP_NS, SE3.identity(), MISSION), source="matcher"),
        ],
    )

    assert delete_loops(map_, mission_row=1)[1] == 1
    assert delete_loops(map_, mission_row=0)[1] == 2
    assert delete_loops(map_, source="matcher")[1] == 1
    assert delete_loops(map_, kinds=["odometry"])[1] == 8


YAML = """
loops:
  - mission_a: 0f0f
    stamp_a_ns: 1000
    mission_b: a0a0
    stamp_b_ns: 500001000
    T_a_b: [1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0]
    rotation_sigma_rad: 0.01
    translation_sigma_m: 0.1
"""
CSV = """mission_a,stamp_a_ns,mission_b,stamp_b_ns,x,y,z,qx,qy,qz,qw,rotation_sigma_rad,translation_sigma_m
0f0f,1000,a0a0,500001000,1,2,3,0,0,1,0,0.01,0.1
"""


@pytest.mark.parametrize(("name", "text"), [("l.yaml", YAML), ("l.csv", CSV)])
def test_K5_loops_are_read_from_yaml_and_csv(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)

    [found] = read_loops(tmp_path / name)

    assert (found.mission_a, found.stamp_a_ns) == ("0f0f", 1000)
    assert (found.mission_b, found.stamp_b_ns) == ("a0a0", 500_001_000)
    expected = SE3.from_quat_xyzw([0, 0, 1, 0], [1, 2, 3])
    np.testing.assert_allclose(found.T_a_b.matrix, expected.matrix)
    np.testing.assert_allclose(np.diagonal(found.covariance), [1e-4] * 3 + [1e-2] * 3)
    assert found.is_switchable


def test_mistakes_in_a_file_of_loops_are_named_with_their_line(tmp_path: Path) -> None:
    file, table = tmp_path / "l.yaml", tmp_path / "l.csv"
    file.write_text(YAML.replace("0.0, 1.0, 0.0]", "0.0]"))
    with pytest.raises(ConfigError, match=r"l\.yaml:7: loops\[0\]\.T_a_b: expected x y z qx"):
        read_loops(file)
    file.write_text(YAML + "    sigma: 3\n")
    with pytest.raises(ConfigError, match=r"l\.yaml:10: loops\[0\]\.sigma: unknown key"):
        read_loops(file)
    table.write_text(CSV.replace("1,2,3", "1,two,3"))
    with pytest.raises(RecordingError, match=r"l\.csv:2: could not convert"):
        read_loops(table)
    table.write_text(CSV.replace(",x,", ",east,"))
    with pytest.raises(RecordingError, match=r"l\.csv: line 1 has no column x"):
        read_loops(table)
    with pytest.raises(RecordingError, match=r"loops come as \.yaml, \.yml, \.csv, not '\.json'"):
        read_loops(tmp_path / "l.json")
