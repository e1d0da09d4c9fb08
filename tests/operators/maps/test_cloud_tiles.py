"""Tiles hold together what one cloud holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.maps.cloud_tiles import TilesConfig, write_tiles
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.las_files import read_las
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.build import add_resources
from mapstream.streams.messages.estimates import PointCloud
from tests.recordings.made_maps import line_map

_NUM = 5


def _map(folder: Path) -> Map:
    """Return a map whose vertices each saw 2000 points within 25 m."""
    rng = np.random.default_rng(0)
    with CloudStore(folder / "clouds") as store:
        for row in range(_NUM):
            points = rng.uniform([-25, -25, 0], [25, 25, 3], (2000, 3)).astype(np.float32)
            cloud = PointCloud(stamp_ns=row, points=points, intensity=points[:, 2])
            store.put(f"c{row}", cloud)
    rows = np.arange(_NUM)
    paths = [f"clouds/c{row}.arrow" for row in rows]
    return add_resources(line_map(_NUM), vertex_rows=rows, kind="cloud", paths=paths)


def test_O11_tiles_hold_the_whole_cloud_each_in_its_square(tmp_path: Path) -> None:
    map_ = _map(tmp_path)
    whole = aggregate_cloud(map_, tmp_path, AggregateConfig(voxel_size_m=0.5))

    report = write_tiles(
        map_, tmp_path, tmp_path / "tiles", TilesConfig(voxel_size_m=0.5, tile_m=20)
    )

    index = json.loads((tmp_path / "tiles" / "tiles.json").read_text())
    assert len(index["tiles"]) == len(report.files) - 1 >= 9
    assert report.num_points == len(whole.points)
    found = []
    for tile in index["tiles"]:
        points = read_las(tmp_path / "tiles" / tile["file"]).points
        corner = 20 * np.array([int(n) for n in tile["file"].removesuffix(".laz").split("_")])
        assert (np.abs(points[:, :2] - corner - 10) < 10.001).all()  # rounded to millimetres
        np.testing.assert_allclose(points.min(axis=0), tile["low"], atol=0.001)
        found.append(points)
    apart_m, nearest = cKDTree(whole.points).query(np.concatenate(found))
    assert apart_m.max() < 0.002
    assert len(np.unique(nearest)) == len(whole.points)
    assert sorted(path.name for path in (tmp_path / "tiles").iterdir()) == sorted(
        path.name for path in report.files
    )  # what waited on disk is gone
