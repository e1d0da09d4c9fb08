"""Objects and regions for geographic programs: in the map's frame, or where they are on Earth."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.maps.export import ExportConfig, export_map
from mapstream.operators.maps.naming import name_landmark
from mapstream.operators.maps.regions import RegionConfig, add_region
from mapstream.operators.maps.statistics import map_statistics
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.tables import Frames
from tests.operators.maps.test_naming import CUP, furnished

MUNICH = (48.137, 11.575, 520.0)


def named() -> Map:
    kitchen = RegionConfig(
        name="kitchen", polygon=((0, 0.5), (0, 2), (4, 2), (4, 0.5)), z_m=0.0, height_m=2.5
    )
    map_, _ = add_region(furnished(), kitchen)
    return name_landmark(map_, CUP, "my cup")[0]


def features(map_: Map, folder: Path, **options: object) -> dict[str, Any]:
    config = ExportConfig.model_validate(options)
    report = export_map(map_, folder, folder / "map.geojson", config)
    assert report.written == {"landmarks": 4, "regions": 1}
    document: dict[str, Any] = json.loads((folder / "map.geojson").read_text())
    return document


def test_objects_and_regions_are_in_the_frame_of_a_map_without_a_place_on_earth(
    tmp_path: Path,
) -> None:
    document = features(named(), tmp_path)

    cup, *_, table, kitchen = document["features"]
    assert (document["type"], document["frame"]) == ("FeatureCollection", "map")
    assert cup["geometry"]["coordinates"] == pytest.approx([1.0, 1.0, 0.8])
    assert cup["properties"] == {
        "kind": "object", "class": "cup", "name": "my cup", "region": "kitchen",
        "extent_m": [0.1, 0.1, 0.12], "num_observations": 0,
    }  # fmt: skip
    (ring,) = table["geometry"]["coordinates"]
    assert len(ring) == 5
    assert ring[0] == ring[-1]
    (ring,) = kitchen["geometry"]["coordinates"]  # it was given the other way round
    corners = np.array(ring)[:, :2]
    around = np.array([[4, 0.5], [4, 2], [0, 2], [0, 0.5], [4, 0.5]])
    np.testing.assert_allclose(corners, around, atol=1e-9)


def test_where_satellites_saw_the_map_coordinates_are_longitude_and_latitude(
    tmp_path: Path,
) -> None:
    enu = Frames(
        id=id_array([derived_id("frame", "enu")]),
        name=np.array(["enu"], dtype=object),
        crs=np.array(["enu"], dtype=object),
        origin_lla=np.array([MUNICH]),
    )

    document = features(replace(named(), frames=enu), tmp_path)
    own_axes = features(replace(named(), frames=enu), tmp_path, crs="map")

    longitude, latitude, height_m = document["features"][0]["geometry"]["coordinates"]
    assert "frame" not in document
    assert (latitude - MUNICH[0]) * 111_200 == pytest.approx(1.0, rel=0.01)
    assert (longitude - MUNICH[1]) * 111_320 * np.cos(np.deg2rad(MUNICH[0])) == pytest.approx(
        1, rel=0.01
    )
    assert height_m == pytest.approx(MUNICH[2] + 0.8, abs=1e-3)
    assert own_axes["frame"] == "map"


def test_tables_tell_objects_with_size_and_region(tmp_path: Path) -> None:
    export_map(named(), tmp_path, tmp_path / "tables", ExportConfig())

    with (tmp_path / "tables" / "objects.csv").open() as lines:
        cup, *_ = csv.DictReader(lines)
    assert (cup["label"], cup["name"], cup["region"]) == ("cup", "my cup", "kitchen")
    assert [float(cup[f"size_{axis}_m"]) for axis in "xyz"] == [0.1, 0.1, 0.12]
    with (tmp_path / "tables" / "regions.csv").open() as lines:
        corners = list(csv.DictReader(lines))
    assert [float(corner["x_m"]) for corner in corners] == pytest.approx([0, 0, 4, 4])
    assert {corner["height_m"] for corner in corners} == {"2.5"}


def test_statistics_count_classes_and_regions() -> None:
    found = map_statistics(named())

    assert found.objects == {"cup": 2, "cupboard": 1}
    assert found.regions == {"room": 1}
