"""Registration of keyframes: which pairs are tried, what is believed, and what comes of a second call."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.lidar.constraints.candidates import CandidatesConfig, candidates
from mapstream.operators.lidar.constraints.covariances import TABLE, fixed_covariance
from mapstream.operators.lidar.constraints.keyframe_clouds import KeyframeClouds
from mapstream.operators.lidar.constraints.register import SOURCE, RegisterConfig, register
from mapstream.operators.maps.steps import MapSteps, MapStepsConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.build import anchored, with_poses
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.errors import ConfigError, MapError
from mapstream.streams.geometry import SE3
from tests.operators.lidar.drives import (
    DRIFT,
    HALL,
    MISSION,
    OTHER_MISSION,
    both,
    circle,
    rms_m,
    stored,
    submap_of,
    worst_edge_m,
)
from tests.operators.scenes import corridor

CONFIG = RegisterConfig(neighbours=0)


def straight(num: int, step_m: float = 1.0) -> Map:
    """Return a map of a drive along x, without clouds."""
    return append_submap(
        Map.empty(),
        submap_of([SE3.exp([0, 0, 0, k * step_m, 0, 0]) for k in range(num)], SE3.identity()),
    )


def pairs(map_: Map, config: CandidatesConfig) -> set[tuple[int, int, str]]:
    rows = np.arange(len(map_.vertices))
    return {(p.vertex_a, p.vertex_b, p.relation) for p in candidates(map_, rows, config)}


def test_I10_keyframes_in_a_row_are_candidates_within_20_s_5_m_180_deg() -> None:
    near, far = straight(4), straight(4, step_m=5.5)

    assert pairs(near, CandidatesConfig(within=False)) == {
        (k, k + 1, "consecutive") for k in range(3)
    }
    assert pairs(far, CandidatesConfig()) == set()
    assert pairs(near, CandidatesConfig(within=False, max_gap_s=0.5)) == set()
    turned = with_poses(near, np.array([1]), SE3.exp([0, 0, 1.2, 1, 0, 0]).matrix[None])
    assert (0, 1, "consecutive") not in pairs(turned, CandidatesConfig(max_turn_deg=60))


def test_I11_the_closest_three_within_2_m_and_2_m_apart_along_the_way_are_candidates() -> None:
    there = [SE3.exp([0, 0, 0, 0.5 * k, 0, 0]) for k in range(8)]
    back = [SE3.exp([0, 0, 0, 0.5 * k, 0.3, 0]) for k in reversed(range(8))]
    map_ = append_submap(Map.empty(), submap_of([*there, *back], SE3.identity()))

    found = pairs(map_, CandidatesConfig(consecutive=False))

    assert {a for a, b, _ in found if b == 12} == {2, 3, 4}  # at 1.5 m, where the third was
    position = map_.vertices.T_mission_base[:, :3, 3]
    for a, b, relation in found:
        assert relation == "within"
        assert np.linalg.norm(position[a] - position[b]) <= 2.0
        assert abs(b - a) * 0.5 >= 1.7  # the turn adds 0.3 m and takes 0.5 m
    assert max(sum(b == row for _, b, _ in found) for row in range(16)) == 3


def test_I11_missions_meet_only_where_both_places_are_known(tmp_path: Path) -> None:
    first = stored(submap_of(circle(6)), tmp_path)
    second = stored(submap_of(circle(6), mission=OTHER_MISSION, seed=50), tmp_path)
    map_ = both(first, second)

    assert not {p for p in pairs(map_, CandidatesConfig()) if p[2] == "between"}
    map_ = anchored(map_, 1, circle(6)[0])
    assert {p for p in pairs(map_, CandidatesConfig()) if p[2] == "between"}

    joined, report = register(map_, CONFIG, tmp_path)

    assert report.added["between"] >= 6
    assert worst_edge_m(joined, SOURCE, [circle(6), circle(6)]) < 0.02
    assert check_map(joined) == []


def test_I10_I13_registration_takes_the_drift_out(tmp_path: Path) -> None:
    """Odometry is 0.37 m off at the end of the circle; edges may be switched off and are worth what the table says."""
    truth = circle()
    map_ = stored(submap_of(truth), tmp_path)

    registered, report = register(map_, CONFIG, tmp_path)
    solved, _ = optimize_map(registered)

    assert rms_m(map_, truth) > 0.1
    assert rms_m(solved, truth) < 0.01
    rows = np.flatnonzero(registered.edges.source == SOURCE)
    assert len(rows) == report.num_added == report.num_tried
    assert registered.edges.is_switchable[rows].all()
    assert (registered.edges.kind[rows] == "loop").all()
    assert np.array_equal(registered.edges.covariance[rows[0]], fixed_covariance("lidar", "gicp"))
    assert check_map(registered) == []
    again, _ = register(map_, CONFIG, tmp_path)
    assert again.digest() == registered.digest()


def test_I13_the_table_says_what_an_edge_is_worth(tmp_path: Path) -> None:
    table = tmp_path / "mine.yaml"
    table.write_text(
        "covariances:\n  - {sensor: radar, method: icp, rotation_sigma_rad: 0.1, translation_sigma_m: 0.2}\n"
    )

    found = fixed_covariance("radar", "icp", table)

    assert np.allclose(np.sqrt(np.diag(found)), [0.1] * 3 + [0.2] * 3)
    assert TABLE.is_file()
    with pytest.raises(
        ConfigError, match="no covariance for the sensor 'radar' and the method 'gicp'"
    ):
        fixed_covariance("radar", "gicp", table)


def test_I13_an_alignment_far_from_the_graph_is_refused(tmp_path: Path) -> None:
    """The gates are 0.5 m and 10 deg; a pose 0.7 m off is refused, with the reason."""
    truth = circle(6)
    map_ = stored(submap_of(truth, SE3.identity()), tmp_path)
    moved = (truth[-1] @ SE3.exp([0, 0, 0, 0.5, 0.5, 0])).matrix
    map_ = with_poses(map_, np.array([5]), moved[None])

    _, report = register(
        map_, RegisterConfig(neighbours=0, search_distances_m=(2.0, 1.0)), tmp_path
    )

    told = {(p.stamp_a_ns // 10**9, p.stamp_b_ns // 10**9): p.verdict for p in report.pairs}
    assert "m from the guess, more than 0.50 m" in told[4, 5]
    assert told[3, 4] == "accepted"


def test_I13_an_edge_that_was_switched_off_is_tried_again_from_better_poses(tmp_path: Path) -> None:
    truth = circle()
    map_ = stored(submap_of(truth), tmp_path)
    registered, first = register(map_, CONFIG, tmp_path)
    rows = np.flatnonzero(registered.edges.source == SOURCE)
    wrong = registered.edges.T_a_b.copy()
    wrong[rows[3]] = (SE3(wrong[rows[3]]) @ SE3.exp([0, 0, 0.3, 1.5, 0, 0])).matrix
    solved, _ = optimize_map(replace(registered, edges=replace(registered.edges, T_a_b=wrong)))
    assert solved.edges.switch[rows[3]] < 0.5

    redone, report = register(solved, CONFIG, tmp_path)

    assert (report.num_removed, report.num_added) == (1, 1)
    assert report.num_kept == first.num_added - 1
    assert worst_edge_m(redone, SOURCE, [truth]) < 0.02


def test_I18_registering_again_on_better_poses_makes_the_map_no_worse(tmp_path: Path) -> None:
    """Neighbours are merged by poses that are wrong in the same way at each step; that must not grow."""
    truth = circle()
    map_ = stored(submap_of(truth), tmp_path)
    config = RegisterConfig(neighbours=2, within=False)
    errors_m = [rms_m(map_, truth)]
    for _ in range(2):
        map_, report = register(
            map_, config.model_copy(update={"again": len(errors_m) > 1}), tmp_path
        )
        assert report.num_added == 15
        map_, _ = optimize_map(map_)
        errors_m.append(rms_m(map_, truth))

    assert errors_m[1] < errors_m[0] / 5
    assert errors_m[2] <= errors_m[1] + 1e-3


def test_a_bare_corridor_gives_no_edge_along_which_nothing_holds(tmp_path: Path) -> None:
    poses = [SE3.exp([0, 0, 0, 0.5 * k, 0, 0]) for k in range(3)]
    map_ = stored(submap_of(poses, SE3.identity(), world=corridor()), tmp_path)

    _, report = register(map_, CONFIG, tmp_path)

    assert report.num_added == 0
    assert all("nothing holds the position" in p.verdict for p in report.pairs)


def test_neighbours_of_two_keyframes_share_no_cloud_and_memory_is_bounded(tmp_path: Path) -> None:
    map_ = stored(submap_of(circle()), tmp_path)
    clouds = KeyframeClouds(map_, tmp_path, max_bytes=200_000)
    sizes = [len(clouds.at(v)) for v in range(16)]

    target, source = clouds.of_pair(7, 8, 2)

    assert (len(target), len(source)) == (sizes[7], sizes[8])
    target, source = clouds.of_pair(2, 7, 3)
    assert (len(target), len(source)) == (sum(sizes[:5]), sum(sizes[5:10]))
    target, source = clouds.of_pair(4, 11, 2)
    assert (len(target), len(source)) == (sum(sizes[2:7]), sum(sizes[9:14]))
    assert clouds.num_bytes <= 200_000


def test_a_map_with_clouds_needs_its_folder(tmp_path: Path) -> None:
    map_ = stored(submap_of(circle(3)), tmp_path)

    with pytest.raises(MapError, match="nobody said in which folder"):
        register(map_)
    (tmp_path / str(map_.resources.path[0])).unlink()
    with pytest.raises(MapError, match="no such cloud"):
        register(map_, CONFIG, tmp_path)


@pytest.mark.anyio
async def test_I10_registration_works_in_a_graph_before_the_map_is_stored() -> None:
    submap = submap_of(circle(6), DRIFT, world=HALL, mission=MISSION)
    plain = append_submap(Map.empty(), submap)
    steps = [{"tool": "register", "config": {"neighbours": 0}}, {"tool": "optimize"}]
    config = MapStepsConfig.model_validate({"steps": steps})

    [made] = (await run_operator(MapSteps(config), submaps=[submap], maps=[plain]))["maps"]

    assert (made.edges.source == SOURCE).sum() >= 5
    assert rms_m(made, circle(6)) < rms_m(plain, circle(6)) / 5
    assert len(made.resources) == len(plain.resources)
