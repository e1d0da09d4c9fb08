"""Each kind of file is fed and read as it wants: boxes, classes, scores and masks where they belong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mapstream.operators.objects.object_detector import ObjectDetectorConfig, ObjectFinder
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.objects.detectors.files import (
    detector_file,
    yolov8_file,
    yolox_file,
    yolox_rows,
)


def find(file: Path, size_px: tuple[int, int], **options: object) -> ObjectDetections:
    """Return what a file finds in an image of a width and a height."""
    image = np.full((size_px[1], size_px[0], 3), 50, np.uint8)
    frame = CameraFrame(stamp_ns=7, image=image, encoding="bgr8", frame="left")
    config = ObjectDetectorConfig.model_validate({"model": file, **options})
    return ObjectFinder(config).find([frame])[0]


def halves(side: int) -> npt.NDArray[np.float32]:
    """Return prototypes (2, side, side): one that is positive on the left, one everywhere."""
    left = np.where(np.arange(side) < side // 2, 1.0, -1.0)
    return np.stack([np.tile(left, (side, 1)), np.ones((side, side))]).astype(np.float32)


def test_J1_yolox_boxes_are_where_their_cells_say(tmp_path: Path) -> None:
    rows = yolox_rows()
    rows[2 * 8 + 3] = [0.5, 0.25, np.log(2), 0.0, 0.9, 0.1, 0.8, 0.0]  # 8 px: row 2, column 3
    rows[32 + 4 + 2] = [0.0, 0.0, 0.0, np.log(2), 0.5, 0.0, 0.0, 1.0]  # 16 px: row 1, column 2
    rows[41] = [0.0, 0.0, 0.0, 0.0, 0.9, 0.2, 0.2, 0.2]  # too unsure
    file = yolox_file(tmp_path, rows, names="{0: 'person', 1: 'cup', 2: 'chair'}")

    found = find(file, (128, 64))  # twice as large as the network's

    assert found.labels == ("cup", "chair")
    np.testing.assert_allclose(found.scores, [0.72, 0.5], rtol=1e-6)
    # the middles are (28, 18) and (32, 16) px from the corner, the sides (16, 8) and (16, 32)
    in_network = np.array([[20, 14, 36, 22], [24, 0, 40, 32]])
    np.testing.assert_allclose(found.boxes_px, in_network * 2 - 0.5, atol=1e-4)
    assert (found.stamp_ns, found.frame, found.width_px, found.height_px) == (7, "left", 128, 64)
    assert found.masks == ()


def test_networks_of_half_precision_are_read(tmp_path: Path) -> None:
    rows = yolox_rows()
    rows[41] = [0.0, 0.5, 0.0, 0.0, 0.9, 0.0, 1.0, 0.0]
    outputs = {"output": rows[None].astype(np.float16)}
    names = {"names": "['a', 'b', 'c']"}
    file = detector_file(tmp_path, outputs, [1, 3, 32, 64], names, np.float16)

    found = find(file, (64, 32))

    assert found.labels == ("b",)
    np.testing.assert_allclose(found.boxes_px, [[15.5, -0.5, 47.5, 31.5]], atol=1e-3)
    np.testing.assert_allclose(found.scores, [0.9], atol=1e-3)


def test_boxes_end_with_the_image_and_not_with_the_grey_beside_it(tmp_path: Path) -> None:
    rows = yolox_rows()
    rows[41] = [0.0, 0.5, np.log(4), np.log(4), 0.9, 1.0, 0.0, 0.0]
    rows[7] = [0.5, 0.5, 0.0, 0.0, 0.9, 1.0, 0.0, 0.0]  # in the grey alone
    file = yolox_file(tmp_path, rows, names="['a', 'b', 'c']")

    found = find(file, (32, 32))

    np.testing.assert_array_equal(found.boxes_px, [[-0.5, -0.5, 31.5, 31.5]])


def test_J1_yolov8_masks_are_sums_of_prototypes(tmp_path: Path) -> None:
    things = [
        ((32, 32, 16, 8), 1, 0.9, (1.0, 0.0)),
        ((12, 40, 8, 8), 2, 0.6, (1.0, 0.0)),
        ((50, 20, 8, 4), 0, 0.5, (-1.0, 0.0)),
    ]
    file = yolov8_file(tmp_path, things, halves(16))

    found = find(file, (128, 64))  # half as large in the network, with 16 px of grey above

    assert found.labels == ("cup", "chair", "person")
    in_network = np.array([[24, 12, 40, 20], [8, 20, 16, 28], [46, 2, 54, 6]])
    np.testing.assert_allclose(found.boxes_px, in_network * 2 - 0.5, atol=1e-4)
    assert [mask.shape for mask in found.masks] == [(16, 32), (16, 16), (8, 16)]
    np.testing.assert_array_equal(found.masks[0], np.tile(np.arange(32) < 16, (16, 1)))
    assert found.masks[1].all()
    assert found.masks[2].all()
    assert found.mask_sources == ("model", "model", "model")


def test_a_mask_without_a_pixel_gives_way_to_the_box(tmp_path: Path) -> None:
    file = yolov8_file(tmp_path, [((50, 30, 8, 8), 1, 0.9, (1.0, 0.0))], halves(16))

    found = find(file, (64, 64))

    assert found.mask_sources == ("box",)
    assert found.masks[0].shape == (8, 8)
    assert found.masks[0].all()


def test_yolov8_without_prototypes_has_boxes_alone(tmp_path: Path) -> None:
    file = yolov8_file(tmp_path, [((32, 32, 16, 8), 2, 0.9, ())], None)

    found = find(file, (64, 64))

    assert (found.labels, found.masks) == (("chair",), ())
    np.testing.assert_allclose(found.boxes_px, [[23.5, 27.5, 39.5, 35.5]], atol=1e-4)


def rcnn_file(
    folder: Path, masks: npt.NDArray[np.float32], names: tuple[str, ...], label: int = 47
) -> Path:
    """Write a Mask R-CNN for images of any size that finds a cup (a label) and a person."""
    values: tuple[npt.NDArray[Any], ...] = (
        np.array([[4, 6, 20, 14], [10, 0, 40, 30]], np.float32),
        np.array([label, 1], np.int64),
        np.array([0.7, 0.8], np.float32),
        masks,
    )
    outputs = dict(zip(names, values, strict=True))
    return detector_file(folder, outputs, [3, "height", "width"])


@pytest.mark.parametrize(
    "names", [("boxes", "labels", "scores", "masks"), ("6568", "6570", "6572", "6887")]
)
def test_J1_mask_rcnn_has_masks_of_the_image(tmp_path: Path, names: tuple[str, ...]) -> None:
    masks = np.zeros((2, 1, 30, 40), np.float32)
    masks[0, 0, 8:12, 6:18] = 0.9
    masks[1, 0, :, 25:] = 0.6
    file = rcnn_file(tmp_path, masks, names)

    found = find(file, (40, 30))

    assert found.labels == ("person", "cup")  # the best first
    np.testing.assert_array_equal(found.boxes_px, [[9.5, -0.5, 39.5, 29.5], [3.5, 5.5, 19.5, 13.5]])
    np.testing.assert_array_equal(found.full_mask(0), masks[1, 0] > 0.5)
    np.testing.assert_array_equal(found.full_mask(1), masks[0, 0] > 0.5)


def test_J1_mask_rcnn_may_have_masks_of_its_boxes(tmp_path: Path) -> None:
    masks = np.zeros((2, 1, 4, 4), np.float32)
    masks[0, 0, :, :2] = 1.0
    masks[1, 0, 2:] = 1.0
    file = rcnn_file(tmp_path, masks, ("boxes", "labels", "scores", "masks"))

    found = find(file, (40, 30))

    np.testing.assert_array_equal(found.masks[1], np.tile(np.arange(16) < 8, (8, 1)))
    np.testing.assert_array_equal(found.masks[0], np.tile(np.arange(30)[:, None] >= 15, (1, 30)))


def test_mask_rcnn_may_find_nothing(tmp_path: Path) -> None:
    outputs: dict[str, npt.NDArray[Any]] = {
        "boxes": np.zeros((0, 4), np.float32),
        "labels": np.zeros(0, np.int64),
        "scores": np.zeros(0, np.float32),
        "masks": np.zeros((0, 1, 30, 40), np.float32),
    }

    found = find(detector_file(tmp_path, outputs, [3, 30, 40]), (40, 30))

    assert (len(found), found.masks) == (0, ())


def test_a_label_that_has_no_name_is_told(tmp_path: Path) -> None:
    masks = np.ones((2, 1, 4, 4), np.float32)
    file = rcnn_file(tmp_path, masks, ("boxes", "labels", "scores", "masks"), label=120)

    with pytest.raises(OperatorError, match="class 120, but there are names for 91; give a text"):
        find(file, (40, 30))


def test_fastest_det_has_a_box_for_each_cell(tmp_path: Path) -> None:
    grid = np.zeros((1, 5 + 2, 2, 4), np.float32)
    grid[0, :, 1, 2] = [0.8, np.arctanh(0.5), 0.0, 0.0, np.log(3), 0.1, 0.9]
    file = detector_file(tmp_path, {"758": grid}, [1, 3, 32, 64], {"names": "['door', 'sign']"})

    found = find(file, (128, 128))

    assert found.labels == ("sign",)
    np.testing.assert_allclose(found.scores, [0.8**0.6 * 0.9**0.4], rtol=1e-5)
    # its middle is 2.5 of 4 cells and 1 of 2 cells from the corner, its sides 1/2 and 3/4 of the image
    np.testing.assert_allclose(found.boxes_px, [[47.5, 15.5, 111.5, 111.5]], atol=1e-3)
