"""Maps are drawn into files without a display."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.graph.map_picture import PictureConfig, write_picture
from mapstream.graph.views.colors import mission_color
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.build import add_resources
from mapstream.streams.errors import ConfigError, MapError
from mapstream.streams.messages.estimates import PointCloud
from tests.recordings.made_maps import line_map

_CONFIG = PictureConfig(width_px=400, voxel_size_m=0.01)


def _map_with_a_wall(folder: Path) -> Map:
    """A drive along x, and a red wall at y = 3 m."""
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-1, 6, 4000), rng.uniform(0, 0.5, 4000)
    points = np.column_stack([x, np.full(4000, 3.0), z]).astype(np.float32)
    colors = np.tile(np.array([255, 0, 0, 255], np.uint8), (4000, 1))
    with CloudStore(folder / "clouds") as store:
        store.put("c", PointCloud(stamp_ns=0, points=points, colors_rgba=colors))
    return add_resources(
        line_map(6), vertex_rows=np.array([0]), kind="cloud", paths=["clouds/c.arrow"]
    )


def test_P3_a_picture_shows_the_wall_and_the_way_where_they_are(tmp_path: Path) -> None:
    notes = write_picture(_map_with_a_wall(tmp_path), tmp_path, tmp_path / "m.png", _CONFIG)

    image = cv2.imread(str(tmp_path / "m.png"))
    assert image is not None
    assert notes == []
    red = np.argwhere((image == [0, 0, 255]).all(axis=2))
    color = mission_color(0)
    way = np.argwhere(
        (image == [color >> 8 & 255, color >> 16 & 255, color >> 24 & 255]).all(axis=2)
    )
    px_per_m = (np.ptp(red[:, 1]) + 1) / 7
    assert len(red) > 300
    assert len(way) > 50
    begin = way[way[:, 1] < way[:, 1].min() + px_per_m / 4]  # at y = 0, 3 m below the wall
    assert begin[:, 0].mean() - red[:, 0].mean() == pytest.approx(3 * px_per_m, abs=3)


def test_P3_walls_of_a_planar_laser_are_bright(tmp_path: Path) -> None:
    """They have one height, so no ramp of heights tells them from the background."""
    wall = np.column_stack([np.linspace(0, 5, 500), np.full(500, 3.0), np.zeros(500)])
    with CloudStore(tmp_path / "clouds") as store:
        store.put("c", PointCloud(stamp_ns=0, points=wall.astype(np.float32)))
    map_ = add_resources(
        line_map(6), vertex_rows=np.array([0]), kind="cloud", paths=["clouds/c.arrow"]
    )

    write_picture(map_, tmp_path, tmp_path / "m.png", _CONFIG)

    image = cv2.imread(str(tmp_path / "m.png"))
    assert image is not None
    assert (image[:30].min(axis=2) > 150).sum() > 200


def test_P3_a_page_holds_everything_it_shows(tmp_path: Path) -> None:
    write_picture(_map_with_a_wall(tmp_path), tmp_path, tmp_path / "m.html", _CONFIG)

    page = (tmp_path / "m.html").read_text()
    assert "THREE" in page
    assert not re.findall(r'(?:src|href)=["\']?https?://', page)


def test_a_map_without_clouds_is_drawn_with_a_note(tmp_path: Path) -> None:
    (note,) = write_picture(line_map(5), tmp_path, tmp_path / "m.png", _CONFIG)
    assert "drawn without clouds" in note
    assert (tmp_path / "m.png").stat().st_size > 100


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a picture is a \.png or an \.html, not '\.jpg'"):
        write_picture(line_map(5), tmp_path, tmp_path / "m.jpg", _CONFIG)
    with pytest.raises(MapError, match="nothing to draw"):
        write_picture(Map.empty(), tmp_path, tmp_path / "m.png", _CONFIG)
