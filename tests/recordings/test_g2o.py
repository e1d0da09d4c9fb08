"""Pose graphs go through g2o files and come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.recordings.g2o import read_g2o, write_g2o
from mapstream.recordings.maps import Map, check_map
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import invert, se3_log
from tests.data import shared
from tests.recordings.made_maps import full_map, line_map

PRECISE = "100 0 0 100 0 100"  # an information matrix
GRAPHS = ["tinyGrid3D", "smallGrid3D", "MIT", "CSAIL", "intel"]


def half_chi2(map_: Map) -> float:
    """Half the sum of squared, whitened residuals at the poses of the map."""
    edges = map_.edges
    rows = np.flatnonzero(edges.vertex_b >= 0)
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    T_a_b = invert(poses[edges.vertex_a[rows]]) @ poses[edges.vertex_b[rows]]
    residual = se3_log(invert(edges.T_a_b[rows]) @ T_a_b)
    information = np.linalg.inv(edges.covariance[rows])
    return float(0.5 * np.einsum("ni,nij,nj->", residual, information, residual))


@pytest.mark.parametrize("name", GRAPHS)
def test_S3_benchmarks_make_clean_maps_and_round_trip(name: str, tmp_path: Path) -> None:
    map_ = read_g2o(shared("posegraphs") / f"{name}.g2o")

    left_out = write_g2o(map_, tmp_path / f"{name}.g2o")
    again = read_g2o(tmp_path / f"{name}.g2o")

    assert check_map(map_) == []
    assert not left_out
    np.testing.assert_array_equal(again.vertices.stamp_ns, map_.vertices.stamp_ns)
    np.testing.assert_allclose(
        again.vertices.T_mission_base, map_.vertices.T_mission_base, atol=1e-12
    )
    np.testing.assert_array_equal(again.edges.vertex_a, map_.edges.vertex_a)
    np.testing.assert_array_equal(again.edges.vertex_b, map_.edges.vertex_b)
    np.testing.assert_allclose(again.edges.T_a_b, map_.edges.T_a_b, atol=1e-12)
    np.testing.assert_allclose(again.edges.covariance, map_.edges.covariance, rtol=1e-6, atol=1e-12)
    assert half_chi2(again) == pytest.approx(half_chi2(map_), rel=1e-6)


def test_S3_writing_what_was_read_gives_the_same_lines(tmp_path: Path) -> None:
    source = shared("posegraphs") / "MIT.g2o"

    write_g2o(read_g2o(source), tmp_path / "MIT.g2o")

    def numbers(path: Path) -> list[tuple[str, ...]]:
        rows = [line.split() for line in path.read_text().splitlines()]
        return sorted((r[0], *r[1 : 3 if r[0] == "EDGE_SE2" else 2]) for r in rows)

    assert numbers(tmp_path / "MIT.g2o") == numbers(source)


def test_vertices_without_a_line_are_placed_along_odometry(tmp_path: Path) -> None:
    """The loop says 9 m, the odometry 2 m; near numbers are trusted first."""
    lines = [
        "EDGE_SE2 0 2 9 0 0 1 0 0 1 0 1",
        "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1",
        "EDGE_SE2 2 1 -1 0 0 1 0 0 1 0 1",
    ]

    map_ = read(lines, tmp_path)

    np.testing.assert_allclose(map_.vertices.T_mission_base[:, 0, 3], [0, 1, 2])
    assert map_.edges.kind.tolist() == ["loop", "odometry", "odometry"]


def read(lines: list[str], folder: Path) -> Map:
    (folder / "graph.g2o").write_text("\n".join(lines))
    return read_g2o(folder / "graph.g2o")


def test_information_has_rotation_first_here(tmp_path: Path) -> None:
    upper = np.diag([1.0, 2, 3, 4, 5, 6])[np.triu_indices(6)]
    values = " ".join(map(str, upper))
    lines = [f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 {values}", "FIX 0"]

    map_ = read(lines, tmp_path)

    np.testing.assert_allclose(
        np.diag(map_.edges.covariance[0]), 1 / np.array([4.0, 5, 6, 1, 2, 3])
    )
    assert map_.edges.kind.tolist() == ["odometry", "fixed"]
    write_g2o(map_, tmp_path / "again.g2o")
    assert "FIX 0\n" in (tmp_path / "again.g2o").read_text()
    assert read_g2o(tmp_path / "again.g2o").edges.kind.tolist() == ["odometry", "fixed"]


def test_directions_without_information_are_infinite(tmp_path: Path) -> None:
    upper = np.diag([1.0, 1, 0, 0, 0, 1])[np.triu_indices(6)]
    lines = [f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 {' '.join(map(str, upper))}"]

    map_ = read(lines, tmp_path)

    np.testing.assert_array_equal(
        np.diag(map_.edges.covariance[0]), [np.inf, np.inf, 1, 1, 1, np.inf]
    )
    assert check_map(map_) == []
    write_g2o(map_, tmp_path / "again.g2o")
    np.testing.assert_array_equal(
        read_g2o(tmp_path / "again.g2o").edges.covariance, map_.edges.covariance
    )


def test_a_map_in_space_round_trips_and_names_what_it_leaves_out(tmp_path: Path) -> None:
    map_ = full_map()
    switch = np.ones(len(map_.edges))
    switch[1] = 0.1
    off = replace(map_.edges, switch=switch)

    left_out = write_g2o(replace(map_, edges=off), tmp_path / "map.g2o")

    assert left_out == {"imu": 5, "odometry": 1, "absolute": 1}
    again = read_g2o(tmp_path / "map.g2o")
    np.testing.assert_allclose(
        again.vertices.T_mission_base, map_.vertices.T_mission_base, atol=1e-12
    )
    np.testing.assert_allclose(again.edges.covariance[0], map_.edges.covariance[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["VERTEX_SE2 0 0 0 0", "VERTEX_XY 1 0 0"], r"line 2: 'VERTEX_XY' is not known here"),
        (["VERTEX_SE2 0 0 0"], "line 1: expected 4 values after VERTEX_SE2, got 3"),
        (["VERTEX_SE2 0 0 zero 0"], "line 1: could not convert string to float"),
        (["VERTEX_SE2 0 0 nan 0"], "line 1: a value is not finite"),
        (["VERTEX_SE2 0.5 0 0 0"], "line 1: invalid literal for int"),
        (["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0"], "line 1: quaternion without a direction"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1"], "line 1: the information matrix is not positive"),
        (["VERTEX_SE2 0 0 0 0", "EDGE_SE2 5 6 1 0 0 1 0 0 1 0 1"], "no line places vertex 5"),
        (["# nothing"], "no vertices and no edges"),
    ],
)  # fmt: skip
def test_bad_lines_are_named(lines: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=f"graph.g2o.*{message}"):
        read(lines, tmp_path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no\.g2o: cannot be read: No such file"):
        read_g2o(tmp_path / "no.g2o")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_g2o(line_map(2), tmp_path / "no" / "map.g2o")


def test_S3_several_files_are_several_missions(tmp_path: Path) -> None:
    """Without letters numbers clash, and each file is a mission; files of one name tell their folders."""
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "graph.g2o").write_text(f"EDGE_SE2 0 1 1 0 0 {PRECISE}\n")

    map_ = read_g2o(tmp_path / "one/graph.g2o", tmp_path / "two/graph.g2o")

    assert map_.missions.name.tolist() == ["one/graph.g2o", "two/graph.g2o"]
    assert map_.missions.is_base_frame_known.tolist() == [True, False]
    assert map_.edges.vertex_a.tolist() == [0, 2]
    assert map_.edges.kind.tolist() == ["odometry", "odometry"]
    assert check_map(map_) == []


def test_S3_letters_are_robots_and_a_loop_in_both_files_counts_once(tmp_path: Path) -> None:
    a, b = ord("a") << 56, ord("b") << 56
    loop = f"EDGE_SE2 {a + 1} {b} 5 0 0 {PRECISE}"
    robots = {
        "0.g2o": [f"EDGE_SE2 {a} {a + 1} 1 0 0 {PRECISE}", loop],
        "1.g2o": [f"EDGE_SE2 {b} {b + 1} 2 0 0 {PRECISE}", loop, f"FIX {b}"],
    }
    for name, lines in robots.items():
        (tmp_path / name).write_text("\n".join(lines))

    map_ = read_g2o(tmp_path / "0.g2o", tmp_path / "1.g2o")

    assert map_.missions.name.tolist() == ["0.g2o a", "0.g2o b"]
    assert map_.vertices.stamp_ns.tolist() == [0, 1, 0, 1]
    assert map_.vertices.T_mission_base[:, 0, 3].tolist() == [0, 1, 0, 2]
    assert map_.edges.kind.tolist() == ["odometry", "loop", "odometry", "fixed"]
    assert map_.edges.is_switchable.tolist() == [False, True, False, False]
    assert check_map(map_) == []


@pytest.mark.parametrize(
    ("folder", "num_vertices", "num_loops"),
    [("clean/example_4robots", 440, 87), ("spoiled/example_2robots", 284, 31)],
)
def test_S3_a_simulated_team_is_read_from_the_files_of_its_robots(
    folder: str, num_vertices: int, num_loops: int
) -> None:
    files = sorted((shared("multirobot_argos") / folder).glob("*.g2o"))

    map_ = read_g2o(*files)

    assert len(map_.missions) == len(files)
    assert len(map_.vertices) == num_vertices
    loops = map_.edges_of("loop")
    assert len(loops) == num_loops
    missions = map_.vertices.mission[[map_.edges.vertex_a[loops], map_.edges.vertex_b[loops]]]
    np.testing.assert_array_equal(map_.edges.is_switchable[loops], missions[0] != missions[1])
    assert check_map(map_) == []
