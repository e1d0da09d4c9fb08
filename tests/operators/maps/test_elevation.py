"""The ground is found below what stands on it, and lies where it is."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.maps.elevation import (
    ElevationConfig,
    elevation_of,
    write_elevation,
    write_orthomosaic,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError, MapError


def _hills(xy: FloatArray) -> FloatArray:
    height: FloatArray = 2 * np.sin(xy[:, 0] / 9) + np.cos(xy[:, 1] / 7) + 0.05 * xy[:, 0]
    return height


def _land(seed: int = 0) -> FloatArray:
    """Return points (N, 3) on hills; over a third of the land plants stand up to 3 m high."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-30, 30, (60_000, 2))
    ground = np.column_stack([xy, _hills(xy) + rng.normal(0, 0.03, len(xy))])
    plants = ground[(xy[:, 0] > 5) & (rng.random(len(xy)) < 0.5)]
    return np.concatenate([ground, plants + [0, 0, 1] * rng.uniform(0.5, 3, (len(plants), 1))])


def test_O12_the_ground_is_within_20_cm_below_plants() -> None:
    grid = elevation_of(_land(), None, ElevationConfig(cell_m=0.5))

    rows, columns = np.nonzero(np.isfinite(grid.heights_m))
    east = grid.west_m + (columns + 0.5) * grid.cell_m
    north = grid.north_m - (rows + 0.5) * grid.cell_m
    error = grid.heights_m[rows, columns] - _hills(np.column_stack([east, north]))
    assert len(rows) == 120 * 120
    assert np.sqrt(np.mean(error**2)) < 0.1  # the row asks for 0.2 m
    top = elevation_of(_land(), None, ElevationConfig(cell_m=0.5, surface="top"))
    assert np.nanmax(top.heights_m - grid.heights_m) > 2


def test_O12_holes_are_filled_only_near_what_was_seen() -> None:
    land = _land()
    land = land[np.hypot(land[:, 0] + 10, land[:, 1]) > 5]  # a pond
    grid = elevation_of(land, None, ElevationConfig(cell_m=0.5, fill_cells=2))

    assert np.isnan(grid.heights_m[60, 40])  # its middle
    assert np.isnan(grid.heights_m).sum() < np.pi * 9**2


def test_O12_files_tell_where_the_cells_lie(tmp_path: Path) -> None:
    land = _land() + np.array([465_000.0, 5_247_000.0, 400.0])
    colors = np.tile(np.array([10, 20, 30, 255], np.uint8), (len(land), 1))
    grid = elevation_of(land, colors, ElevationConfig(cell_m=1.0), wkt='PROJCRS["some"]')

    heights = write_elevation(grid, tmp_path / "dem.tif")
    picture = write_orthomosaic(grid, tmp_path / "ortho.png")

    assert [path.name for path in heights] == ["dem.tif", "dem.tfw", "dem.prj"]
    assert [path.name for path in picture] == ["ortho.png", "ortho.pgw", "ortho.prj"]
    read = cv2.imread(str(tmp_path / "dem.tif"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, grid.heights_m)
    world = [float(line) for line in (tmp_path / "dem.tfw").read_text().split()]
    assert world == [1.0, 0.0, 0.0, -1.0, 464_970.5, 5_247_029.5]
    ortho = cv2.imread(str(tmp_path / "ortho.png"), cv2.IMREAD_UNCHANGED)
    assert ortho is not None
    assert ortho[5, 5].tolist() == [30, 20, 10, 255]


def test_what_cannot_be_drawn_is_said(tmp_path: Path) -> None:
    grid = elevation_of(_land(), None, ElevationConfig())
    with pytest.raises(ConfigError, match=r"heights go into a \.tif"):
        write_elevation(grid, tmp_path / "dem.jpg")
    with pytest.raises(MapError, match="have no colours"):
        write_orthomosaic(grid, tmp_path / "ortho.png")
    far = np.array([[0.0, 0.0, 0.0], [1e6, 1e6, 0.0]])
    with pytest.raises(MapError, match="are too many"):
        elevation_of(far, None, ElevationConfig(cell_m=0.5))
