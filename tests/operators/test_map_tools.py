"""What the tools for maps count, join and write."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.maps.statistics import coobservability, map_statistics
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.build import add_resources, with_poses
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.tables import Observations
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import PointCloud
from tests.recordings.made_maps import OTHER_MISSION, full_map, line_map

NUM_VERTICES = 8


def test_M14_statistics_of_a_map_made_by_hand() -> None:
    map_ = merge_maps([full_map(), line_map(4, OTHER_MISSION)])
    switches = np.array([1.0, 0.2, *[1.0] * 12])
    map_ = replace(map_, edges=replace(map_.edges, switch=switches))

    found = map_statistics(map_)

    first, second = found.missions
    assert (first.num_vertices, first.is_anchored, first.num_observations) == (6, True, 5)
    assert (second.num_vertices, second.is_anchored, second.num_observations) == (4, False, 0)
    assert first.start_ns == 1_000
    times_s = [first.duration_s, first.step_s, first.longest_gap_s]
    np.testing.assert_allclose(times_s, [2.5, 0.5, 0.5])
    np.testing.assert_array_equal(second.T_map_mission, map_.missions.T_map_mission[1])
    assert found.length_m == pytest.approx(8 * np.linalg.norm([1.0, 0.0, 0.02]), rel=1e-3)
    assert [(e.kind, e.count, e.num_switched_off) for e in found.edges] == [
        ("absolute", 1, 0),
        ("imu", 5, 0),
        ("odometry", 8, 1),
    ]
    assert found.landmarks == {"lidar": 1, "object": 1, "visual": 2}
    assert found.resources == {"record": 10}
    assert found.num_rows["vertices"] == 10


def test_M14_coobservability_counts_landmarks_seen_from_both_missions() -> None:
    map_ = merge_maps([full_map(), line_map(4, OTHER_MISSION)])
    observations = Observations(
        vertex=np.array([0, 1, 7, 8, 9, 2]),
        landmark=np.array([0, 0, 0, 0, 2, -1]),
        sensor=np.array(["camera"] * 6, dtype=object),
        keypoint_px=np.ones((6, 2), dtype=np.float32),
    )

    counts = coobservability(replace(map_, observations=observations))

    np.testing.assert_array_equal(counts, [[1, 1], [1, 2]])
    np.testing.assert_array_equal(coobservability(Map.empty()), np.empty((0, 0)))


def wall_map(folder: Path, T_map_base: np.ndarray) -> Map:
    """A map whose vertices each saw the wall y = 5 m from where they truly were; poses have drifted."""
    map_ = line_map(NUM_VERTICES)
    rng = np.random.default_rng(3)
    with CloudStore(folder / "clouds") as store:
        for row, T_base_map in enumerate(invert(T_map_base)):
            wall = np.column_stack(
                [rng.uniform(0, 10, 400), np.full(400, 5.0), rng.uniform(0, 3, 400)]
            )
            seen = wall @ T_base_map[:3, :3].T + T_base_map[:3, 3] + rng.normal(0, 0.005, (400, 3))
            points = seen.astype(np.float32)
            store.put(
                f"c{row}", PointCloud(stamp_ns=row, points=points, intensity=points[:, 0] * 0 + 7)
            )
    rows = np.arange(NUM_VERTICES)
    return add_resources(
        map_, vertex_rows=rows, kind="cloud", paths=[f"clouds/c{row}.arrow" for row in rows]
    )


def test_O2_the_cloud_follows_the_optimised_poses(tmp_path: Path) -> None:
    """The wall is thick by the drifted poses, and less than 3 cm by the true ones."""
    truth = np.array(
        [SE3.exp([0, 0, 0.1 * i, 0.8 * i, 0.1, 0]).matrix for i in range(NUM_VERTICES)]
    )
    drifted = np.array(
        [SE3.exp([0, 0, 0.01 * i, 0, 0.05 * i, 0]).matrix for i in range(NUM_VERTICES)]
    )
    map_ = wall_map(tmp_path, truth)
    rows, config = np.arange(NUM_VERTICES), AggregateConfig(voxel_size_m=0.05)

    before = aggregate_cloud(with_poses(map_, rows, drifted @ truth), tmp_path, config)
    after = aggregate_cloud(with_poses(map_, rows, truth), tmp_path, config)

    assert float(np.ptp(np.percentile(before.points[:, 1], [1, 99]))) > 0.2
    assert float(np.ptp(np.percentile(after.points[:, 1], [1, 99]))) < 0.03
    assert after.intensity is not None
    np.testing.assert_allclose(after.intensity, 7, rtol=1e-6)


def test_one_point_is_left_per_voxel(tmp_path: Path) -> None:
    map_ = wall_map(tmp_path, np.tile(np.eye(4), (NUM_VERTICES, 1, 1)))
    map_ = with_poses(map_, np.arange(NUM_VERTICES), np.eye(4))

    cloud = aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=1.0))

    cells = np.floor(cloud.points)
    assert len(np.unique(cells, axis=0)) == len(cells) <= 11 * 2 * 4


def test_O11_a_cloud_of_too_many_voxels_gets_larger_ones(tmp_path: Path) -> None:
    map_ = wall_map(tmp_path, np.tile(np.eye(4), (NUM_VERTICES, 1, 1)))
    map_ = with_poses(map_, np.arange(NUM_VERTICES), np.eye(4))

    fine = aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=0.05))
    bounded = aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=0.05, max_voxels=200))
    coarse = aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=0.8))

    assert len(fine.points) > 1000
    assert 50 < len(bounded.points) <= 200
    assert len(coarse.points) == len(bounded.points)
    np.testing.assert_allclose(bounded.points, coarse.points, atol=1e-4)


def test_missions_that_are_not_anchored_are_left_out(tmp_path: Path) -> None:
    map_ = wall_map(tmp_path, np.tile(np.eye(4), (NUM_VERTICES, 1, 1)))
    unknown = replace(map_.missions, is_base_frame_known=np.array([False]))
    map_ = replace(map_, missions=unknown)

    with pytest.raises(MapError, match="no clouds of missions whose place is known"):
        aggregate_cloud(map_, tmp_path, AggregateConfig())

    cloud = aggregate_cloud(map_, tmp_path, AggregateConfig(with_unanchored=True))
    assert len(cloud.points)


def test_a_map_without_clouds_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=f"{tmp_path}: there are no clouds at all"):
        aggregate_cloud(line_map(3), tmp_path, AggregateConfig())


def test_points_beyond_the_voxels_are_refused(tmp_path: Path) -> None:
    map_ = wall_map(tmp_path, np.tile(np.eye(4), (NUM_VERTICES, 1, 1)))

    with pytest.raises(MapError, match="beyond 1 m of the map's origin; use larger voxels"):
        aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=1e-6))
