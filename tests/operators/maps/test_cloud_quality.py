"""The sharper of two maps is found without truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.maps.cloud_quality import (
    CloudQualityConfig,
    cloud_quality,
    map_cloud_quality,
)
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.build import add_resources, with_poses
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import PointCloud
from tests.recordings.made_maps import line_map

_NUM, _CONFIG = 6, CloudQualityConfig(max_points=2000)


def _room(rng: np.random.Generator, num: int = 2500) -> FloatArray:
    """Return points (N, 3) on a floor and three walls, 1 cm rough."""
    free = rng.uniform(0, 4, (num, 2))
    surface = rng.integers(0, 4, num)
    points = np.select(
        [surface[:, None] == k for k in range(4)],
        [
            np.column_stack([free, np.zeros(num)]),
            np.column_stack([free[:, 0], np.full(num, 4.0), free[:, 1] / 2]),
            np.column_stack([np.full(num, 4.0), free[:, 0], free[:, 1] / 2]),
            np.column_stack([np.zeros(num), free[:, 0], free[:, 1] / 2]),
        ],
    )
    return points + rng.normal(0, 0.01, points.shape)


def _seen_from(poses: FloatArray, folder: Path, seed: int) -> Map:
    """Return a map whose vertices saw the room from these poses."""
    rng = np.random.default_rng(seed)
    with CloudStore(folder / "clouds") as store:
        for row, T_base_map in enumerate(invert(poses)):
            points = _room(rng) @ T_base_map[:3, :3].T + T_base_map[:3, 3]
            store.put(f"c{row}", PointCloud(stamp_ns=row, points=points.astype(np.float32)))
    rows = np.arange(_NUM)
    paths = [f"clouds/c{row}.arrow" for row in rows]
    return add_resources(line_map(_NUM), vertex_rows=rows, kind="cloud", paths=paths)


@pytest.mark.parametrize("seed", range(10))
def test_R8_the_map_with_the_better_poses_is_the_sharper_one(seed: int, tmp_path: Path) -> None:
    """Poses that are 1 cm and 0.2 degrees off against those that are 3 cm and 0.6 degrees off."""
    rng = np.random.default_rng(seed)
    truth = np.array([SE3.exp([0, 0, 0.2 * i, 1 + 0.3 * i, 2, 1]).matrix for i in range(_NUM)])
    map_ = _seen_from(truth, tmp_path, seed)
    off = rng.normal(size=(_NUM, 6)) * np.repeat([0.0035, 0.01], 3)
    better, worse = (
        map_cloud_quality(
            with_poses(map_, np.arange(_NUM), truth @ [SE3.exp(k * each).matrix for each in off]),
            tmp_path,
            _CONFIG,
        )
        for k in (1, 3)
    )

    assert better.entropy < worse.entropy
    assert better.plane_sigma_m < worse.plane_sigma_m


def test_R8_the_thickness_of_a_wall_is_measured() -> None:
    rng = np.random.default_rng(1)
    for sigma_m in (0.01, 0.03):
        wall = np.column_stack([rng.uniform(0, 5, (40_000, 2)), rng.normal(0, sigma_m, 40_000)])
        assert cloud_quality(wall, _CONFIG).plane_sigma_m == pytest.approx(sigma_m, rel=0.05)


def test_the_covariances_of_neighbourhoods_are_numpys() -> None:
    rng = np.random.default_rng(2)
    cloud = rng.normal(0, 0.1, (30, 3)) + 1e5  # far from zero, as in a projection
    found = cloud_quality(cloud, CloudQualityConfig(radius_m=10.0))
    expected = np.linalg.slogdet(2 * np.pi * np.e * np.cov(cloud.T, bias=True))[1] / 2
    assert found.entropy == pytest.approx(expected, abs=1e-4)


def test_points_without_neighbours_are_named() -> None:
    with pytest.raises(MapError, match="no point of the cloud has 8 neighbours"):
        cloud_quality(np.arange(30.0).reshape(10, 3) * 100, _CONFIG)
