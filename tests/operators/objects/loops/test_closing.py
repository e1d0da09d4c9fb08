"""Loops closed by objects in stored maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.maps.relax import relax_map
from mapstream.operators.objects.loops.candidates import DriftGate
from mapstream.operators.objects.loops.closing import (
    SemanticLoopsConfig,
    SemanticLoopsReport,
    close_semantic_loops,
)
from mapstream.operators.objects.loops.edges import EdgeConfig
from mapstream.operators.objects.loops.seen_together import seen_together, shared
from mapstream.recordings.maps.build import anchored
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, se3_exp
from tests.operators.objects.loops.made_rooms import OTHER, Visit, map_of, moved, square

LABELS = ["chair", "chair", "table", "cup", "cup", "screen", "plant", "book"]
DRIFT = se3_exp(np.array([0.0, 0.0, 0.15, 0.4, -0.3, 0.05]))
HERE, LATER_S = np.array([2.0, -3.0, 0.5]), 60.0


def room(seed: int, num: int = 8, size: float = 3.0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-size / 2, size / 2, (num, 3)) * [1, 1, 0.4]


def seen_twice(
    seed: int = 0, *, labels: list[str] = LABELS, points: FloatArray | None = None
) -> Map:
    """A room, and the same room a minute later, drifted; or other things there."""
    rng = np.random.default_rng(seed + 100)
    again = moved(DRIFT, room(seed)) + rng.normal(0, 0.02, (8, 3)) if points is None else points
    first = Visit(LABELS, room(seed), square(HERE))
    return map_of(first, Visit(labels, again, moved(DRIFT, square(HERE)), LATER_S))


def verdicts(report: SemanticLoopsReport) -> set[str]:
    return {pair.verdict for pair in report.candidates}


@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 9)), max_size=40))
def test_J6_members_share_a_group_exactly_if_one_has_both(rows: list[tuple[int, int]]) -> None:
    members, groups = np.array(rows, np.int64).reshape(-1, 2).T

    together = shared(members, groups, 8)

    for a in range(8):
        for b in range(8):
            both = {g for m, g in rows if m == a} & {g for m, g in rows if m == b}
            assert together[a, b] == (a == b or bool(both))


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.integers(0, 7), st.integers(0, 7))
def test_J6_what_one_image_shows_is_never_the_same(seed: int, a: int, b: int) -> None:
    """Whatever objects are where, and however much alike: two of one image are never matched."""
    rng = np.random.default_rng(seed)
    map_ = seen_twice(seed)
    seen = map_.observations
    # one image of the first visit shows an object of the second as well, as after a wrong merge
    rows = np.flatnonzero(seen.landmark == 8 + b)
    vertex = seen.vertex.copy()
    vertex[rows[: rng.integers(1, len(rows) + 1)]] = seen.vertex[seen.landmark == a][0]
    changed = replace(map_, observations=replace(seen, vertex=vertex))

    _, report = close_semantic_loops(changed, SemanticLoopsConfig(min_gap_s=0))

    together = seen_together(changed, np.arange(16))
    row_of = {row.tobytes().hex(): n for n, row in enumerate(changed.landmarks.id)}
    for pair in report.candidates:
        if together[row_of[pair.landmark_a], row_of[pair.landmark_b]]:
            assert pair.verdict.startswith("seen together")


def test_J5_J7_J9_objects_seen_again_close_the_loop() -> None:
    map_ = seen_twice()

    closed, report = close_semantic_loops(map_)
    relaxed, _ = relax_map(closed)

    assert report.num_edges == 1
    row = int(np.flatnonzero(closed.edges.kind == "loop")[0])
    assert closed.edges.is_switchable[row]
    assert closed.edges.source[row] == "semantic_loops"
    assert report.loops[0].num_objects == len(LABELS)
    T = closed.vertices.T_mission_base
    a, b = int(closed.edges.vertex_a[row]), int(closed.edges.vertex_b[row])
    off = invert(closed.edges.T_a_b[row]) @ invert(T[a]) @ invert(DRIFT) @ T[b]
    assert np.linalg.norm(off[:3, 3]) < 0.05
    off = invert(relaxed.vertices.T_mission_base[-1]) @ invert(DRIFT) @ T[-1]
    assert np.linalg.norm(off[:3, 3]) < 0.1 * np.linalg.norm(DRIFT[:3, 3])
    assert check_map(closed) == []


def test_J5_objects_of_other_classes_are_no_candidates() -> None:
    labels = [f"other {label}" for label in LABELS]
    _, report = close_semantic_loops(seen_twice(labels=labels))
    assert report.candidates == []


def test_J5_descriptors_choose_candidates() -> None:
    """Of ten alike chairs five are looked at, and none whose descriptor is further than the threshold."""
    rng = np.random.default_rng(0)
    points = room(1, 10)
    near = np.eye(12, dtype=np.float32)[:10]
    blurred = near * 0.8 + np.eye(12, dtype=np.float32)[10] * 0.6
    first = Visit(["chair"] * 10, points, square(HERE), descriptors=blurred)
    second = Visit(["chair"] * 10, moved(DRIFT, points), square(HERE), LATER_S, descriptors=blurred)
    anywhere = SemanticLoopsConfig(gate=DriftGate(distance_m=20.0))
    _, report = close_semantic_loops(map_of(first, second), anywhere)
    reasons = [pair.verdict for pair in report.candidates]
    assert reasons.count("others of the class are more alike") == 50
    opposite = replace(second, descriptors=-blurred[rng.permutation(10)])
    _, report = close_semantic_loops(map_of(first, opposite), anywhere)
    assert verdicts(report) == {"descriptors differ too much"}


@pytest.mark.parametrize("seed", range(20))
def test_J7_another_room_with_things_of_the_same_classes_is_refused(seed: int) -> None:
    other = room(seed + 1000)
    _, report = close_semantic_loops(seen_twice(seed, points=other))
    assert report.num_edges == 0
    assert "accepted" not in verdicts(report)


@pytest.mark.parametrize("seed", range(3))
def test_J7_things_that_moved_do_not_hinder_the_rest(seed: int) -> None:
    points = moved(DRIFT, room(seed))
    points[0] += [0.8, 0.5, 0.0]
    _, report = close_semantic_loops(seen_twice(seed, points=points))
    assert report.num_edges == 1
    assert report.loops[0].num_objects == len(LABELS) - 1
    assert all(pair.verdict for pair in report.candidates)


def test_J7_two_objects_are_not_enough() -> None:
    points = room(0)
    first = Visit(["cup", "plant"], points[:2], square(HERE))
    second = Visit(["cup", "plant"], moved(DRIFT, points[:2]), square(HERE), LATER_S)
    _, report = close_semantic_loops(map_of(first, second))
    assert report.num_edges == 0
    assert verdicts(report) == {"no three objects around it agree on a motion"}


def test_rows_of_alike_chairs_are_ambiguous() -> None:
    """Five rows of chairs look the same after a step to the next one; poses drifted by more than that."""
    grid = np.array([[x, y, 0.0] for x in np.arange(5) * 0.6 for y in np.arange(2) * 1.5])
    first = Visit(["chair"] * 10, grid, square(HERE))
    second = Visit(["chair"] * 10, moved(DRIFT, grid), moved(DRIFT, square(HERE)), LATER_S)
    _, report = close_semantic_loops(map_of(first, second))
    assert report.num_edges == 0
    assert any(verdict.startswith("ambiguous") for verdict in verdicts(report))


def test_objects_on_a_line_do_not_say_how_they_are_turned() -> None:
    line = np.linspace(0, 3, 6)[:, None] ** 1.3 * np.array([1.0, 0.3, 0.0])
    labels = ["chair", "table", "cup", "screen", "plant", "book"]
    first = Visit(labels, line, square(HERE))
    second = Visit(labels, moved(DRIFT, line), moved(DRIFT, square(HERE)), LATER_S)
    _, report = close_semantic_loops(map_of(first, second))
    assert report.num_edges == 0
    assert any("line" in verdict for verdict in verdicts(report))


def test_many_alike_objects_are_survived_and_counted() -> None:
    chairs = room(5, 40, size=6.0)
    first = Visit(["chair"] * 40, chairs, square(HERE))
    second = Visit(["chair"] * 40, moved(DRIFT, chairs), moved(DRIFT, square(HERE)), LATER_S)
    config = SemanticLoopsConfig(max_candidates=150)
    _, report = close_semantic_loops(map_of(first, second), config)
    assert report.reasons["there are too many candidates, and others are nearer"] > 100


def test_J9_the_edge_joins_the_closest_vertices_or_the_centres() -> None:
    eyes = HERE + np.array([[3.0, 0, 0], [2.0, 0, 0], [0.0, 0, 0], [4.0, 0, 0], [9.0, 0, 0]])
    points = room(0)
    first = Visit(LABELS, points, eyes)
    second = Visit(LABELS, points, eyes, LATER_S)
    ends = {}
    for choice in ("closest", "topological_center"):
        config = SemanticLoopsConfig(edge=EdgeConfig(vertices=choice))
        map_, _ = close_semantic_loops(map_of(first, second), config)
        row = int(np.flatnonzero(map_.edges.kind == "loop")[0])
        ends[choice] = int(map_.edges.vertex_a[row]), int(map_.edges.vertex_b[row])
    assert ends["closest"] == (2, 7)
    assert ends["topological_center"] == (2, 7) or ends["topological_center"] == (3, 8)


def test_a_second_call_finds_the_same_edges_again() -> None:
    once, first = close_semantic_loops(seen_twice())
    twice, second = close_semantic_loops(once)
    assert twice.digest() == once.digest()
    assert second == first


def test_merged_landmarks_have_all_observations() -> None:
    map_ = seen_twice()
    merged, report = close_semantic_loops(map_, SemanticLoopsConfig(is_merging=True))
    assert report.num_merged == len(LABELS)
    assert len(merged.landmarks) == len(LABELS)
    assert len(merged.observations) == len(map_.observations)
    assert check_map(merged) == []


def test_missions_that_lie_anywhere_are_compared_without_gates() -> None:
    far = se3_exp(np.array([0.1, -0.2, 2.0, 40.0, -20.0, 3.0]))
    points = room(3)
    first = Visit(LABELS, points, square(HERE))
    second = Visit(LABELS, moved(far, points), moved(far, square(HERE)), mission=OTHER)
    map_ = map_of(first, second)

    closed, report = close_semantic_loops(map_)

    assert report.num_edges == 1
    assert report.loops[0].mission_a != report.loops[0].mission_b
    known = anchored(map_, 1, SE3.identity())
    _, report = close_semantic_loops(known, SemanticLoopsConfig(gate=DriftGate(distance_m=3.0)))
    assert report.num_edges == 0
    assert verdicts(report) == {"too far apart by the poses of now"}
    _, report = close_semantic_loops(map_, SemanticLoopsConfig(between=False))
    assert report.candidates == []
    assert check_map(closed) == []
