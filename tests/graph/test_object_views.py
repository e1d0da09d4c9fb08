"""How objects look: over images, in space, in a map; and regions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapstream.graph.tap_map import view_map
from mapstream.graph.tap_sinks import SinkSpec
from mapstream.graph.views.objects import class_color
from mapstream.operators.maps.naming import name_landmark
from mapstream.operators.maps.regions import RegionConfig, add_region
from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.features import add_features
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from tests.graph.rrd import columns_of, read_rrd, strict, values_of
from tests.graph.test_views import drawn
from tests.graph.test_vision_views import ROBOT, recorded_images, seen_map
from tests.operators.maps.test_naming import CUP, TABLE, furnished
from tests.operators.objects.made_detections import detections


def test_objects_are_drawn_over_their_image_and_in_space(tmp_path: Path) -> None:
    """Boxes with class, track, text and score; masks as an image of classes; centres and extents at the camera."""
    seen = detections(
        [(20, 10, 30, 30), (40, 20, 44, 24)],
        labels=("cup", "chair"),
        texts=("", "EXIT"),
        track_ids=np.array([7, -1]),
        masks=(np.ones((21, 11), bool), np.ones((5, 5), bool)),
        points_m=(np.ones((3, 3), np.float32), np.empty((0, 3), np.float32)),
        centers_m=np.array([[0.1, 0.2, 2.0], [np.nan] * 3]),
        extents_m=np.array([[0.2, 0.2, 0.4], [np.nan] * 3]),
    )

    entities = drawn(tmp_path, [seen, detections([], 20)])

    boxes = entities["/op/port"]
    assert values_of(boxes, "Boxes2D:labels") == [["cup #7 0.90", 'chair "EXIT" 0.90'], []]
    colors = values_of(boxes, "Boxes2D:colors")[0]
    assert colors == [class_color("cup"), class_color("chair")]
    (mask,) = values_of(entities["/op/port/masks"], "SegmentationImage:buffer")
    image = np.array(mask, np.uint8).reshape(48, 64)
    assert (image[15, 25], image[22, 42], image[0, 0]) == (1, 2, 0)
    assert "AnnotationContext:context" in columns_of(entities["/op/port/masks"])
    centers, *_ = values_of(entities["/op/port/points/centers"], "Points3D:positions")
    np.testing.assert_allclose(centers, [[0.1, 0.2, 2.0]], rtol=1e-6)
    halves, *_ = values_of(entities["/op/port/points/extents"], "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves, [[0.1, 0.1, 0.2]], rtol=1e-6)
    assert np.ravel(values_of(entities["/op/port/num_objects"], "Scalars:scalars")).tolist() == [
        2,
        0,
    ]


def test_a_thing_that_was_recognised_is_drawn_with_its_class(tmp_path: Path) -> None:
    sign = LandmarkRef(name="EXIT 12", kind="pose", label="door_sign")

    seen = Constraint(stamp_ns=1, kind="landmark", landmark=sign)
    cup = Constraint(stamp_ns=2, kind="landmark", landmark=LandmarkRef(name="7", label="cup"))

    entities = drawn(tmp_path, [seen, replace(seen, stamp_ns=2), cup])

    labels = values_of(entities["/op/port"], "Points3D:labels")
    assert labels == [["door_sign"], ["door_sign"], ["door_sign", "cup"]]


def shown(map_: Map, path: Path) -> dict[str, list[object]]:
    file = path / "map.rrd"
    with strict():
        view_map(map_, None, SinkSpec.parse(f"save={file}").open())
    return read_rrd(file)


def test_P1_objects_planes_and_regions_of_a_map_have_their_names(tmp_path: Path) -> None:
    kitchen = RegionConfig(name="kitchen", polygon=((0, 0), (4, 0), (4, 2)), z_m=0, height_m=2.5)
    charger = RegionConfig(name="charger", kind="place", polygon=((1, 1),))
    map_ = furnished()
    for region in (kitchen, charger):
        map_, _ = add_region(map_, region)
    for row, name in ((CUP, "my cup"), (TABLE, "kitchen table")):
        map_, _ = name_landmark(map_, row, name)

    entities = shown(map_, tmp_path)

    objects = entities["/map/landmarks/object"]
    assert values_of(objects, "Points3D:labels") == [["my cup", "cup", "cupboard"]]
    halves = values_of(entities["/map/landmarks/object/extents"], "Boxes3D:half_sizes")
    np.testing.assert_allclose(halves, [[[0.05, 0.05, 0.06]]], rtol=1e-6)
    planes = entities["/map/landmarks/plane"]
    assert values_of(planes, "LineStrips3D:labels") == [["kitchen table"]]
    (names,) = values_of(entities["/map/regions"], "LineStrips3D:labels")
    assert names == ["kitchen", *[""] * 4]  # floor, ceiling, three corners
    assert values_of(entities["/map/places"], "Points3D:labels") == [["charger"]]


def test_detections_of_a_map_lie_over_its_pictures(tmp_path: Path) -> None:
    recording = tmp_path / "images.mcap"
    map_ = seen_map(recording)
    recorded_images(recording, map_.vertices.stamp_ns.tolist())
    seen = detections(
        [(20, 10, 30, 30)], int(map_.vertices.stamp_ns[1]), masks=(np.ones((21, 11), bool),)
    )
    features = ObjectFeatures(ObjectFeaturesConfig()).features(replace(seen, frame="cam0"))
    map_ = add_features(map_, 0, [(1, features.stamp_ns, features)])

    entities = shown(map_, tmp_path)

    assert values_of(entities[f"{ROBOT}/cam0/objects"], "Boxes2D:labels") == [["cup #0"]]
    assert len(values_of(entities[f"{ROBOT}/cam0/masks"], "SegmentationImage:buffer")) == 1
