"""Visual loops of a map whose truth is known."""

import numpy as np
import pytest

from mapstream.operators.places.anchoring import AnchoringConfig, anchor_missions
from mapstream.operators.places.loops import VisualLoopsConfig, find_visual_loops
from mapstream.operators.places.roc import area_under
from mapstream.recordings.maps import Map, check_map
from mapstream.streams.geometry import SE3, invert
from tests.operators.places import made_maps, scenes

A, B, C = "a" * 32, "b" * 32, "c" * 32
FRONT = {"camera": scenes.camera()}
LAP = made_maps.LAP


@pytest.fixture(scope="module")
def two_laps() -> Map:
    return made_maps.flown(Map.empty(), made_maps.room(), A, made_maps.circle(LAP + 6), FRONT)


@pytest.fixture(scope="module")
def two_missions() -> Map:
    """The second begins half a lap later, in a frame of its own, and is not anchored."""
    map_ = made_maps.flown(Map.empty(), made_maps.room(), A, made_maps.circle(LAP), FRONT)
    half = made_maps.circle(12, first=LAP // 2)
    return made_maps.flown(map_, made_maps.room(), B, half, FRONT, from_origin=True)


def _off(T: np.ndarray, truth: SE3) -> tuple[float, float]:
    off = SE3(invert(truth.matrix) @ T)
    return float(np.linalg.norm(off.t)), float(np.rad2deg(off.angle_rad))


def test_H6_H10_a_lap_flown_again_gives_edges_with_covariance_and_switch(two_laps: Map) -> None:
    changed, report = find_visual_loops(two_laps)

    rows = changed.edges_of("loop")
    assert report.num_edges == len(rows) >= 5
    assert check_map(changed) == []
    assert changed.edges.is_switchable[rows].all()
    assert (changed.edges.switch_variance[rows] == 1e-8).all()
    assert (np.linalg.eigvalsh(changed.edges.covariance[rows]) > 0).all()
    stamps_ns = changed.vertices.stamp_ns
    gaps_ns = stamps_ns[changed.edges.vertex_b[rows]] - stamps_ns[changed.edges.vertex_a[rows]]
    assert gaps_ns.min() >= 10 * 10**9
    truth = made_maps.circle(LAP + 6)
    for row in rows.tolist():
        a, b = changed.edges.vertex_a[row], changed.edges.vertex_b[row]
        metres, degrees = _off(changed.edges.T_a_b[row], truth[a].inverse() @ truth[b])
        assert metres < 0.06  # the drift is ten times as much
        assert degrees < 0.6


def test_H20_every_candidate_has_a_verdict(two_laps: Map) -> None:
    _, report = find_visual_loops(two_laps)

    assert report.candidates
    assert all(candidate.verdict for candidate in report.candidates)
    assert sum(c.verdict == "accepted" for c in report.candidates) == report.num_accepted
    assert report.num_compared == report.num_accepted + sum(report.reasons.values())
    assert all("fewer than" in reason or "no place" in reason for reason in report.reasons)


@pytest.mark.parametrize("scoring", ["votes", "probability"])
def test_H11_both_scores_tell_true_places_from_false_ones(two_laps: Map, scoring: str) -> None:
    """Frames of another room find false places, because descriptors may differ by a third."""
    other = made_maps.room(seed=9)
    map_ = made_maps.flown(two_laps, other, B, made_maps.circle(8), FRONT, from_origin=True)
    loose = {"look": {"max_bits": 0.33}, "covisibility": {"scoring": scoring, "min_matches": 1}}

    _, report = find_visual_loops(map_, VisualLoopsConfig.model_validate(loose))

    assert report.roc
    assert area_under(report.roc) > 0.8


def test_H7_merging_adds_no_edges_and_takes_landmarks_away(two_laps: Map) -> None:
    changed, report = find_visual_loops(two_laps, VisualLoopsConfig(result="merge"))

    assert not len(changed.edges_of("loop"))
    assert report.num_merged > 50
    assert len(changed.landmarks) == len(two_laps.landmarks) - report.num_merged
    assert check_map(changed) == []
    # nearly all that became one are one: they have the number of one point
    seen = changed.observations
    rows = np.flatnonzero(seen.landmark >= 0)
    point = seen.track[rows] % 100_000
    first = {int(mark): int(p) for mark, p in zip(seen.landmark[rows], point, strict=True)}
    same = [first[int(m)] == p for m, p in zip(seen.landmark[rows], point, strict=True)]
    assert np.mean(same) > 0.98


@pytest.mark.parametrize(
    ("within", "between", "expected"),
    [(True, False, {(A, A)}), (False, True, {(A, B)}), (True, True, {(A, A), (A, B), (B, B)})],
)
def test_H10_modes_choose_the_missions(
    *, within: bool, between: bool, expected: set[tuple[str, str]]
) -> None:
    map_ = made_maps.flown(Map.empty(), made_maps.room(), A, made_maps.circle(LAP + 4), FRONT)
    map_ = made_maps.flown(
        map_, made_maps.room(), B, made_maps.circle(5, first=3), FRONT, from_origin=True
    )
    config = VisualLoopsConfig(within=within, between=between)

    changed, _ = find_visual_loops(map_, config)

    edges, mission = changed.edges, changed.vertices.mission
    loops = changed.edges_of("loop")
    found = {
        (changed.mission_id(int(mission[a])), changed.mission_id(int(mission[b])))
        for a, b in zip(edges.vertex_a[loops], edges.vertex_b[loops], strict=True)
    }
    assert found
    assert found <= expected
    assert ((A, A) in found) == within
    assert ((A, B) in found) == between


def test_H14_a_mission_is_anchored_where_it_was_flown(two_missions: Map) -> None:
    changed, report = anchor_missions(two_missions)

    assert report.num_anchored == 1
    assert changed.missions.is_base_frame_known.all()
    truth = made_maps.circle(1, first=LAP // 2)[0]
    metres, degrees = _off(changed.missions.T_map_mission[1], truth)
    assert metres < 0.5  # both missions drift by as much
    assert degrees < 4
    assert check_map(changed) == []


def test_H14_missions_of_another_room_stay_unknown(two_missions: Map) -> None:
    other = made_maps.room(seed=9)
    map_ = made_maps.flown(two_missions, other, C, made_maps.circle(12), FRONT, from_origin=True)

    changed, report = anchor_missions(map_)

    assert changed.missions.is_base_frame_known.tolist() == [True, True, False]
    assert "agree, fewer than" in report.missions[1].verdict


def test_H14_too_few_frames_anchor_nothing(two_missions: Map) -> None:
    changed, report = anchor_missions(two_missions, AnchoringConfig(every=4))

    assert not changed.missions.is_base_frame_known[1]
    assert report.missions[0].verdict.endswith("frames agree, fewer than 10")


def test_H7_missions_that_are_not_anchored_are_not_merged(two_missions: Map) -> None:
    config = VisualLoopsConfig(result="merge", within=False)

    _, before = find_visual_loops(two_missions, config)
    known, _ = anchor_missions(two_missions)
    _, after = find_visual_loops(known, config)

    assert before.num_merged == 0
    assert after.num_merged > 50


def test_A3_a_loop_closes_where_only_the_rear_cameras_see_the_place_again() -> None:
    """The front camera flew along; on the way back it sees other points, the rear one the same."""
    place = made_maps.room()
    rig = {"front": scenes.camera(), "rear": scenes.camera(180)}
    first = made_maps.circle(LAP)
    back = [pose @ SE3.exp([0, 0, np.pi, 0, 0, 0]) for pose in reversed(first[:8])]
    map_ = made_maps.flown(Map.empty(), place, A, first, {"front": rig["front"]})
    map_ = made_maps.flown(map_, place, B, back, rig, from_origin=True)

    changed, report = find_visual_loops(map_, VisualLoopsConfig(within=False))

    truth = [*first, *back]
    assert report.num_edges >= 4
    for row in changed.edges_of("loop").tolist():
        a, b = changed.edges.vertex_a[row], changed.edges.vertex_b[row]
        assert (
            _off(changed.edges.T_a_b[row], truth[a].inverse() @ truth[b])[0] < 0.25
        )  # a lap drifts by 0.6 m


def test_H9_votes_of_several_kinds_add_and_one_that_fails_does_not_block() -> None:
    """Numbers of one kind that nobody recognises beside bits of another."""
    place, blind = made_maps.room(), made_maps.room(3, 300, of_numbers=True)
    other = made_maps.Room(blind.points, made_maps.room(4, 300, of_numbers=True).looks)
    map_ = made_maps.flown(
        Map.empty(), place, A, made_maps.circle(6), FRONT, kinds=(("sift", blind),)
    )
    again = made_maps.flown(map_, place, B, made_maps.circle(5), FRONT, kinds=(("sift", blind),))
    broken = made_maps.flown(map_, place, B, made_maps.circle(5), FRONT, kinds=(("sift", other),))

    _, both = find_visual_loops(again, VisualLoopsConfig(within=False))
    _, one = find_visual_loops(broken, VisualLoopsConfig(within=False))
    _, alone = find_visual_loops(again, VisualLoopsConfig(within=False, kinds=("brisk",)))

    assert set(both.inliers_by_kind) == {"brisk", "sift"}
    assert both.inliers_by_kind["brisk"] == pytest.approx(alone.inliers_by_kind["brisk"], rel=0.1)
    assert one.num_accepted == both.num_accepted == alone.num_accepted == 5
    assert one.inliers_by_kind.get("sift", 0) < 0.05 * both.inliers_by_kind["sift"]


def test_the_same_map_gives_the_same_loops(two_laps: Map) -> None:
    a, b = (find_visual_loops(two_laps)[0].digest() for _ in range(2))

    assert a == b
