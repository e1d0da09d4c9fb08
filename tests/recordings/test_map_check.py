"""Every rule finds what breaks it, and clean maps are clean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.maps import Map, check_map, require_valid
from mapstream.recordings.maps.build import add_resources, with_poses
from mapstream.recordings.maps.combine import merge_maps, select_missions, with_journal_entry
from mapstream.recordings.maps.structure_rules import STRUCTURE_RULES
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.maps.value_rules import VALUE_RULES
from mapstream.streams.errors import MapCheckError
from mapstream.streams.geometry import se3_exp
from tests.recordings.made_maps import MISSION, OTHER_MISSION, full_map, line_map, submaps


def changed(
    table: str, column: str, row: int | tuple[int, int], value: object
) -> Callable[[Map], Map]:
    """A corruption: one value of one row."""

    def corrupt(map_: Map) -> Map:
        old = getattr(map_, table)
        values: npt.NDArray[Any] = getattr(old, column).copy()
        values[row] = value
        return replace(map_, **{table: replace(old, **{column: values})})

    return corrupt


def without_edge(row: int) -> Callable[[Map], Map]:
    return lambda map_: map_.select(edges=np.arange(len(map_.edges)) != row)


REFLECTION = np.diag([1.0, 1.0, -1.0, 1.0])
SCALED = np.diag([2.0, 2.0, 2.0, 1.0])
LOWER_ROW = np.eye(4) + np.eye(4)[[3]].T @ np.array([[0.5, 0, 0, 0]])
LOPSIDED = np.eye(6) + np.diag([0.1], k=5)
INDEFINITE = np.diag([1.0, 1, 1, 1, 1, -1e-3])
HALF_UNMEASURED = np.diag([np.inf, 1, 1, 1, 1, 1]) + np.diag([np.inf] * 5, k=1)
LATER = 10**12

CORRUPTIONS: list[tuple[str, str, int, Callable[[Map], Map]]] = [
    ("references_lead_somewhere", "vertices", 2, changed("vertices", "mission", 2, 1)),
    ("references_lead_somewhere", "vertices", 2, changed("vertices", "mission", 2, -1)),
    ("references_lead_somewhere", "edges", 1, changed("edges", "vertex_a", 1, -2)),
    ("references_lead_somewhere", "edges", 1, changed("edges", "landmark_a", 1, 4)),
    ("references_lead_somewhere", "edges", 1, changed("edges", "frame", 1, 1)),
    ("references_lead_somewhere", "edges", 1, changed("edges", "vertex_b", 1, 6)),
    ("references_lead_somewhere", "imu", 1, changed("imu", "edge", 1, 11)),
    ("references_lead_somewhere", "landmarks", 1, changed("landmarks", "vertex", 1, 6)),
    ("references_lead_somewhere", "observations", 1, changed("observations", "landmark", 1, 4)),
    ("references_lead_somewhere", "observations", 1, changed("observations", "vertex", 1, -1)),
    ("references_lead_somewhere", "resources", 1, changed("resources", "vertex", 1, 99)),
    ("ids_are_unique", "vertices", 1, changed("vertices", "id", 1, full_map().vertices.id[0])),
    ("ids_are_unique", "edges", 3, changed("edges", "id", 3, full_map().edges.id[2])),
    ("ids_are_unique", "landmarks", 3, changed("landmarks", "id", 3, full_map().landmarks.id[2])),
    ("ids_are_unique", "resources", 3, changed("resources", "id", 3, full_map().resources.id[2])),
    ("vertex_ids_are_derived", "vertices", 4, changed("vertices", "id", 4, np.zeros(16))),
    ("stamps_increase", "vertices", 3, changed("vertices", "stamp_ns", 2, LATER)),
    ("edges_lead_somewhere_else", "edges", 2, changed("edges", "vertex_b", 2, 2)),
    ("edges_lead_somewhere_else", "edges", 2, changed("edges", "vertex_a", 2, -1)),
    ("edges_lead_somewhere_else", "edges", 2, changed("edges", "landmark_b", 2, 0)),
    ("references_lead_somewhere", "edges", 2, changed("edges", "landmark_b", 2, -2)),
    ("kinds_are_named", "landmarks", 1, changed("landmarks", "kind", 1, "")),
    ("frames_have_names_of_their_own", "frames", 0, changed("frames", "name", 0, "")),
    ("motion_stays_in_its_mission", "edges", 2, changed("edges", "vertex_b", 2, -1)),
    ("imu_edges_join_neighbours", "edges", 6, changed("edges", "vertex_b", 6, 3)),
    ("imu_samples_belong_to_imu_edges", "imu", 2, changed("imu", "edge", 2, 0)),
    ("imu_samples_are_in_order", "imu", 1, changed("imu", "stamp_ns", 1, 0)),
    ("imu_samples_are_in_order", "imu", 3, changed("imu", "edge", 1, 6)),
    (
        "missions_are_connected",
        "missions",
        0,
        lambda m: without_edge(2)(m.select(edges=m.edges.kind != "imu")),
    ),
    ("finite_transforms", "missions", 0, changed("missions", "T_map_mission", 0, np.inf)),
    ("finite_transforms", "frames", 0, changed("frames", "T_map_frame", 0, np.nan)),
    ("finite_transforms", "vertices", 5, changed("vertices", "T_mission_base", 5, np.nan)),
    ("finite_transforms", "edges", 5, changed("edges", "T_a_b", 5, np.nan)),
    ("rigid_transforms", "vertices", 5, changed("vertices", "T_mission_base", 5, REFLECTION)),
    ("rigid_transforms", "edges", 5, changed("edges", "T_a_b", 5, SCALED)),
    ("rigid_transforms", "frames", 0, changed("frames", "T_map_frame", 0, SCALED)),
    ("rigid_transforms", "missions", 0, changed("missions", "T_map_mission", 0, LOWER_ROW)),
    ("finite_states", "vertices", 1, changed("vertices", "velocity_mps", (1, 2), np.nan)),
    ("finite_states", "vertices", 1, changed("vertices", "gyro_bias_radps", 1, np.inf)),
    ("finite_states", "landmarks", 1, changed("landmarks", "p_base", 1, np.nan)),
    ("finite_states", "landmarks", 1, changed("landmarks", "quat_base_xyzw", (1, 3), 1.0)),
    ("finite_states", "frames", 0, changed("frames", "origin_lla", (0, 2), np.nan)),
    ("quaternions_have_unit_length", "landmarks", 1, changed("landmarks", "quat_base_xyzw", 1, 0.6)),
    ("origins_lie_on_the_earth", "frames", 0, changed("frames", "origin_lla", (0, 0), 91.0)),
    ("finite_imu_samples", "imu", 7, changed("imu", "accel_mps2", (7, 1), np.nan)),
    ("finite_covariances", "edges", 1, changed("edges", "covariance", 1, np.nan)),
    ("finite_covariances", "edges", 1, changed("edges", "covariance", 1, HALF_UNMEASURED)),
    ("finite_covariances", "landmarks", 1, changed("landmarks", "covariance", (1, 0), np.nan)),
    ("symmetric_covariances", "edges", 1, changed("edges", "covariance", 1, LOPSIDED)),
    ("positive_covariances", "edges", 1, changed("edges", "covariance", 1, INDEFINITE)),
    ("positive_covariances", "landmarks", 1, changed("landmarks", "covariance", 1, -np.eye(3))),
    ("switches_between_zero_and_one", "edges", 1, changed("edges", "switch", 1, 1.01)),
    ("switches_between_zero_and_one", "edges", 1, changed("edges", "switch", 1, np.nan)),
    ("switch_variances", "edges", 1, changed("edges", "switch_variance", 1, -1)),
    ("kinds_are_named", "edges", 1, changed("edges", "kind", 1, "")),
    ("kinds_are_named", "resources", 1, changed("resources", "kind", 1, "")),
    ("qualities_are_known", "landmarks", 1, changed("landmarks", "quality", 1, "fair")),
    ("observations_say_something", "observations", 1, changed("observations", "keypoint_px", 1, np.nan)),
    ("observations_have_an_uncertainty", "observations", 1, changed("observations", "sigma", 1, 0)),
    ("feature_sets_are_whole", "feature_sets", 1, changed("feature_sets", "dtype", 1, "object")),
    ("feature_sets_are_whole", "feature_sets", 1, changed("feature_sets", "width", 1, 3)),
    ("feature_sets_are_whole", "observations", 1, changed("observations", "feature", 1, 2)),
    ("feature_sets_are_whole", "observations", 1, changed("observations", "kind", 1, "orb")),
    ("projections_are_whole", "projections", 0, changed("projections", "num_inputs", 0, 3)),
    ("projections_are_whole", "projections", 0, changed("projections", "mean", 0, b"\xff" * 8)),
    ("projections_are_whole", "projections", 0, changed("projections", "use", 0, "art")),
    ("detections_are_whole", "detections", 0, changed("detections", "box_px", (0, 2), np.nan)),
    ("detections_are_whole", "detections", 0, changed("detections", "box_px", (0, 2), -1)),
    ("detections_are_whole", "detections", 0, changed("detections", "image_px", (0, 1), 0)),
    ("detections_are_whole", "detections", 0, changed("detections", "points", 0, b"1234567")),
    ("detections_are_of_objects", "detections", 0, changed("detections", "observation", 0, 4)),
    ("regions_are_whole", "regions", 0, changed("regions", "name", 0, "")),
    ("regions_are_whole", "regions", 0, changed("regions", "outline", 0, b"")),
    ("references_lead_somewhere", "regions", 0, changed("regions", "vertex", 0, 6)),
    ("references_lead_somewhere", "detections", 0, changed("detections", "observation", 0, 99)),
    ("references_lead_somewhere", "observations", 1, changed("observations", "feature_set", 1, 2)),
    ("texts_are_json", "missions", 0, changed("missions", "sensors", 0, "{lidar")),
    ("resources_stay_in_the_folder", "resources", 1, changed("resources", "topic", 1, "")),
]  # fmt: skip


def escaping_resource(map_: Map) -> Map:
    return changed("resources", "path", 1, "../elsewhere")(map_)


@pytest.mark.parametrize(("rule", "table", "row", "corrupt"), CORRUPTIONS)
def test_M15_a_seeded_corruption_is_found(
    rule: str, table: str, row: int, corrupt: Callable[[Map], Map]
) -> None:
    map_ = full_map()
    if rule == "resources_stay_in_the_folder":
        map_ = escaping_resource(map_)

    found = {(v.rule, v.table, v.row) for v in check_map(corrupt(map_))}

    assert (rule, table, row) in found


def test_M15_every_rule_has_a_corruption() -> None:
    rules = {rule.__name__ for rule in (*STRUCTURE_RULES, *VALUE_RULES)}

    assert rules <= {rule for rule, *_ in CORRUPTIONS}
    assert len(CORRUPTIONS) >= 20


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sets(st.integers(1, 7)))
def test_a_map_that_tools_made_is_clean(seed: int, cuts: set[int]) -> None:
    map_ = Map.empty()
    for submap in submaps([*sorted(cuts), 8]):
        map_ = append_submap(map_, submap)
    noise = se3_exp(np.random.default_rng(seed).normal(size=(9, 6)))
    map_ = with_poses(map_, np.arange(9), noise)
    map_ = with_journal_entry(map_, "noise", seed=seed)

    merged = merge_maps([map_, line_map(3, OTHER_MISSION)])

    for made in (map_, merged, select_missions(merged, [OTHER_MISSION]), full_map(), Map.empty()):
        assert check_map(made) == []


def test_files_of_a_map_are_looked_for(tmp_path: Path) -> None:
    map_ = add_resources(
        line_map(3), vertex_rows=np.array([0, 1]), kind="cloud", paths=["clouds/a", "clouds/b"]
    )
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "a").write_bytes(b"points")

    [violation] = check_map(map_, tmp_path)

    assert check_map(map_) == []
    assert (violation.table, violation.row) == ("resources", 4)
    assert str(violation) == f"resources, row 4: {tmp_path}/clouds/b is missing (files_are_there)"


def test_many_violations_of_one_kind_are_counted() -> None:
    map_ = line_map(300)
    broken = replace(map_, edges=replace(map_.edges, switch=np.full(299, 2.0)))

    violations = check_map(broken)

    assert len(violations) == 101
    assert violations[0].sentence == "the switch is 2.0, not 0 to 1"
    assert violations[-1].sentence == "so do 199 rows from here on"
    with pytest.raises(MapCheckError, match=r"breaks 101 times its rules:\n  edges, row 0"):
        require_valid(broken)
    assert require_valid(map_) is map_


def test_missions_apart_may_be_merged_without_edges() -> None:
    assert check_map(merge_maps([line_map(3, MISSION), line_map(3, OTHER_MISSION)])) == []
