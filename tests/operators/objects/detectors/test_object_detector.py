"""The operator: cameras, batches, thresholds, and files and images that it cannot use."""

from __future__ import annotations

import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.objects.object_detector import ObjectDetector, ObjectDetectorConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.recordings.datasets.object_boxes import read_boxes
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from tests.data import model, shared
from tests.operators.networks.files import superpoint_file
from tests.operators.objects.detectors.files import (
    YOLOX_CELLS,
    bright_yolox_file,
    detector_file,
    yolov8_file,
    yolox_file,
    yolox_rows,
)

pytestmark = pytest.mark.anyio
_NAMES = "['person', 'cup', 'chair']"


def seen(
    stamp_ns: int,
    frame: str = "left",
    value: int = 50,
    *,
    size_px: tuple[int, int] = (64, 32),
    camera: CameraCalibration | None = None,
) -> CameraFrame:
    image = np.full(size_px[::-1], value, np.uint8)
    return CameraFrame(stamp_ns=stamp_ns, image=image, encoding="mono8", frame=frame, camera=camera)


async def detected(
    file: Path,
    frames: Sequence[CameraFrame] | Mapping[str, Sequence[CameraFrame]],
    run_context: Context | None = None,
    **options: object,
) -> list[ObjectDetections]:
    inputs = frames if isinstance(frames, Mapping) else {"frames": frames}
    config = ObjectDetectorConfig.model_validate(
        {"model": file, "inputs": tuple(inputs), **options}
    )
    operator = ObjectDetector(config)
    sent = await run_operator(operator, config=config, run_context=run_context, **inputs)
    return sent["detections"]


def scored_file(folder: Path, scores: dict[tuple[int, int], float]) -> Path:
    """Write a YOLOX that finds boxes of 8 px, by cell and class of a score."""
    rows = yolox_rows()
    rows[:, :2] = 0.5
    for (cell, number), score in scores.items():
        rows[cell, 4] = score
        rows[cell, 5 + number] = 1.0
    return yolox_file(folder, rows, names=_NAMES)


@pytest.mark.parametrize("batch", [1, 2, 3, "batch"])
async def test_images_of_several_cameras_keep_their_objects(
    tmp_path: Path, batch: int | str
) -> None:
    """However large the network's batch is, each image is told what is in it, in the order of stamps."""
    file = bright_yolox_file(tmp_path, batch)
    frames = {
        "left": [seen(100, "left", 51), seen(200, "left", 102)],
        "right": [seen(100, "right", 153), seen(200, "right", 0), seen(300, "right", 204)],
        "rear": [seen(200, "rear", 255)],
    }

    found = await detected(file, frames, min_score=0.1, max_overlap=1.0)

    order = [(d.stamp_ns, d.frame) for d in found]
    assert order == [
        (100, "left"), (100, "right"), (200, "left"), (200, "right"), (200, "rear"), (300, "right")
    ]  # fmt: skip
    scores = [float(d.scores.max()) if len(d) else 0.0 for d in found]
    np.testing.assert_allclose(scores, [0.2, 0.6, 0.4, 0.0, 1.0, 0.8], rtol=1e-6)


async def test_a_camera_is_looked_at_so_often(tmp_path: Path) -> None:
    frames = [seen(stamp_ns) for stamp_ns in range(0, 1_000_000_000, 100_000_000)]

    found = await detected(scored_file(tmp_path, {}), frames, period_s=0.3)

    assert [d.stamp_ns // 100_000_000 for d in found] == [0, 3, 6, 9]
    assert all(len(d) == 0 for d in found)


async def test_thresholds_are_of_a_class(tmp_path: Path) -> None:
    scores = {(0, 0): 0.9, (2, 0): 0.5, (4, 1): 0.45, (6, 1): 0.25, (8, 2): 0.9}
    file = scored_file(tmp_path, scores)

    found = await detected(
        file, [seen(1)], min_score=0.6, min_scores={"cup": 0.4}, classes=("person", "cup")
    )

    assert found[0].labels == ("person", "cup")
    np.testing.assert_allclose(found[0].scores, [0.9, 0.45], rtol=1e-6)


async def test_objects_on_top_of_each_other_are_one_of_a_class(tmp_path: Path) -> None:
    rows = yolox_rows()
    rows[10] = [0.5, 0.5, 0, 0, 0.9, 1, 0, 0]
    rows[11] = [-0.4, 0.5, 0, 0, 0.8, 1, 0, 0]  # nearly the same box
    rows[9] = [1.4, 0.5, 0, 0, 0.7, 0, 1, 0]
    rows[8] = [2.5, 0.5, 0, 0, 0.6, 0, 0, 1]  # the first box, taken for another thing
    file = yolox_file(tmp_path, rows, names=_NAMES)

    (once,) = await detected(file, [seen(1)])
    (twice,) = await detected(file, [seen(1)], max_overlap=0.9)
    (all_,) = await detected(file, [seen(1)], max_overlap=1.0, max_class_overlap=1.0)

    assert once.labels == ("person", "cup")
    assert twice.labels == ("person", "person", "cup")
    assert all_.labels == ("person", "person", "cup", "chair")


async def test_five_hundred_objects_in_an_image_are_survived(tmp_path: Path) -> None:
    """All are kept if so many are wanted, and those beyond are counted."""
    rng = np.random.default_rng(0)
    rows = np.zeros((84 * 100, 8), np.float32)  # cells of 640 x 640 px
    chosen = rng.choice(6400, 500, replace=False)  # of 8 px, none on top of another
    rows[chosen, :2] = 0.5
    rows[chosen, 4] = rng.uniform(0.5, 1.0, 500)
    rows[chosen, 5] = 1.0
    file = detector_file(tmp_path, {"output": rows[None]}, [1, 3, 640, 640], {"names": _NAMES})
    context = Context()

    image = seen(1, size_px=(640, 640))

    (all_,) = await detected(file, [image], max_detections=500)
    (best,) = await detected(file, [image], context, max_detections=200)

    assert (len(all_), len(best)) == (500, 200)
    assert list(context.activity.warnings.values()) == [300]
    np.testing.assert_array_equal(best.boxes_px, all_.boxes_px[:200])


async def test_numbers_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    rows = yolox_rows()
    rows[10] = [0.5, 0.5, 0, 0, 0.9, 1, 0, 0]
    rows[13] = [np.nan, 0.5, 0, 0, 0.9, 1, 0, 0]
    rows[15] = [0.5, 0.5, 0, np.inf, 0.9, 1, 0, 0]
    rows[17] = [0.5, 0.5, 0, 0, np.nan, 1, 0, 0]
    rows[19] = [0.5, 0.5, 200, 0, 0.6, 0, 1, 0]  # finite, and larger than any image
    context = Context()

    (found,) = await detected(yolox_file(tmp_path, rows, names=_NAMES), [seen(1)], context)

    assert found.labels == ("person", "cup")
    assert context.activity.losses == {"objects of left whose numbers are not finite": 3}


async def test_empty_masks_are_counted(tmp_path: Path) -> None:
    never = -np.ones((1, 16, 16), np.float32)
    file = yolov8_file(tmp_path, [((32, 32, 16, 8), 1, 0.9, (1.0,))], never)
    context = Context()

    (found,) = await detected(file, [seen(1)], context)

    assert found.mask_sources == ("box",)
    assert found.masks[0].all()
    assert list(context.activity.warnings) == [
        "masks of left without a pixel; the box takes their place"
    ]


async def test_images_of_another_size_than_their_calibration_are_counted(tmp_path: Path) -> None:
    camera = CameraCalibration(
        width_px=10,
        height_px=10,
        focal_px=np.ones(2),
        center_px=np.ones(2),
        distortion_parameters=np.empty(0),
    )
    context = Context()

    found = await detected(
        scored_file(tmp_path, {(0, 0): 0.9}), [seen(1, camera=camera), seen(2)], context
    )

    assert [d.stamp_ns for d in found] == [2]
    assert list(context.activity.losses.values()) == [1]


async def test_depth_is_no_image_for_a_detector(tmp_path: Path) -> None:
    depth = np.zeros((32, 64), np.uint16)
    frame = CameraFrame(stamp_ns=1, image=depth, encoding="16UC1", frame="depth")

    with pytest.raises(OperatorError, match="images of depth are 16UC1; it takes bgr8"):
        await detected(scored_file(tmp_path, {}), [frame])


async def test_files_that_are_no_detector_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no network in .*none\.onnx; expected an ONNX file"):
        await detected(tmp_path / "none.onnx", [])
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ConfigError, match="not a network that can be run"):
        await detected(tmp_path / "text.onnx", [])
    with pytest.raises(ConfigError, match=r"expected one input, an image \(B, 3, H, W\)"):
        await detected(superpoint_file(tmp_path), [])
    yolov5 = {"output": np.zeros((1, 3 * YOLOX_CELLS, 85), np.float32)}
    with pytest.raises(
        ConfigError, match=r"for an image of 64 x 32 px it gives .*126, 85.*yolov8: outp"
    ):
        await detected(detector_file(tmp_path, yolov5, [1, 3, 32, 64]), [])
    with pytest.raises(ConfigError, match=r"expected mask_rcnn: outputs boxes \(N, 4\)"):
        await detected(scored_file(tmp_path, {}), [], layout="mask_rcnn")


async def test_classes_have_names(tmp_path: Path) -> None:
    file = yolox_file(tmp_path, yolox_rows())
    names = tmp_path / "names.txt"
    with pytest.raises(ConfigError, match="no names for its 3 classes; give a text file"):
        await detected(file, [])
    with pytest.raises(ConfigError, match=r"names\.txt: expected names of classes"):
        await detected(file, [], class_names=names)
    names.write_text("person\ncup\n")
    with pytest.raises(ConfigError, match=r"3 classes, but .*names\.txt names 2; expected one"):
        await detected(file, [], class_names=names)
    names.write_text("person\ncup\nchair\n\n")
    with pytest.raises(
        ConfigError, match="knows no class couch, sofa; it knows person, cup, chair"
    ):
        await detected(file, [], class_names=names, classes=("sofa",), min_scores={"couch": 0.1})
    torn = yolox_file(tmp_path, yolox_rows(), names="{0: 'person', 2: ")
    with pytest.raises(ConfigError, match="expected `names` of its classes by number, found"):
        await detected(torn, [])


def office() -> tuple[list[CameraFrame], list[ObjectDetections]]:
    """Return real images of two desks, and what a larger network found in them."""
    folder = shared("tum_fr3_office_objects")
    frames, known = [], []
    with tarfile.open(folder / "yolo_txts.tar.gz") as archive:
        for index, path in enumerate(sorted((folder / "images_1hz").glob("*.png"))):
            image = cv2.imread(str(path))
            assert image is not None
            frames.append(CameraFrame(stamp_ns=index, image=image, encoding="bgr8", frame="color"))
            text = archive.extractfile(f"yolo_txts/{path.stem}.txt")
            assert text is not None
            known.append(
                read_boxes(text.read().decode(), path, index, frame="color", size_px=(640, 480))
            )
    return frames, known


def is_among(known: ObjectDetections, row: int, found: ObjectDetections) -> bool:
    """Tell whether a thing was found again: its class, and half of what either box covers in both."""
    box = known.boxes_px[row]
    alike = np.array([label == known.labels[row] for label in found.labels], bool)
    low = np.maximum(box[:2], found.boxes_px[:, :2])
    high = np.minimum(box[2:], found.boxes_px[:, 2:])
    shared_px = np.prod(np.maximum(high - low, 0), axis=1)
    sizes_px = np.prod(found.boxes_px[:, 2:] - found.boxes_px[:, :2], axis=1)
    either_px = sizes_px + np.prod(box[2:] - box[:2]) - shared_px
    return bool((alike & (shared_px >= 0.5 * either_px)).any())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "least"), [("yolox_nano_416.onnx", 36), ("fastestdet_352.onnx", 41)]
)
async def test_J1_real_networks_find_the_objects_found_before(file: str, least: int) -> None:
    """Of 45 things that a larger network was sure of, so many are found again by class and place."""
    network = model(file)
    frames, known = office()

    found = await detected(network, frames, min_score=0.3)

    sure = [
        (k, row) for k, of in enumerate(known) for row in range(len(of)) if of.scores[row] > 0.6
    ]
    again = [is_among(known[k], row, found[k]) for k, row in sure]
    assert len(sure) == 45
    assert sum(again) >= least
