"""What a network finds stays with the map: boxes, masks, and how they came to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.operators.objects.object_detector import ObjectDetectorConfig, ObjectFinder
from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.recordings.maps import check_map, load_map, save_map
from mapstream.recordings.maps.detections import mask_of
from mapstream.recordings.maps.features import add_features
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.objects.detectors.files import yolov8_file
from tests.recordings.made_maps import line_map


def test_J1_boxes_and_masks_of_a_network_stay_with_the_map(tmp_path: Path) -> None:
    left = np.where(np.arange(16) < 8, 1.0, -1.0)
    prototypes = np.tile(left, (1, 16, 1)).astype(np.float32)
    things = [((32, 32, 16, 8), 1, 0.9, (1.0,)), ((50, 20, 8, 8), 2, 0.8, (1.0,))]
    file = yolov8_file(tmp_path, things, prototypes)
    map_ = line_map(2)
    stamp_ns = int(map_.vertices.stamp_ns[1])
    image = np.zeros((64, 64, 3), np.uint8)
    frame = CameraFrame(stamp_ns=stamp_ns, image=image, encoding="bgr8", frame="left")
    (found,) = ObjectFinder(ObjectDetectorConfig(model=file)).find([frame])
    features = ObjectFeatures(ObjectFeaturesConfig()).features(found)

    save_map(add_features(map_, 0, [(1, stamp_ns, features)]), tmp_path / "map")

    again = load_map(tmp_path / "map")
    assert check_map(again) == []
    first = len(again.detections.observation) - 2
    np.testing.assert_array_equal(again.detections.box_px[first:], found.boxes_px)
    assert again.detections.mask_source[first:].tolist() == ["model", "box"]
    for row in range(2):
        area, mask = mask_of(again, first + row)
        assert area == found.window(row)
        np.testing.assert_array_equal(mask, found.masks[row])
    np.testing.assert_array_equal(found.masks[0], np.tile(np.arange(16) < 8, (8, 1)))
    assert again.observations.label[again.detections.observation[first:]].tolist() == [
        "cup",
        "chair",
    ]
