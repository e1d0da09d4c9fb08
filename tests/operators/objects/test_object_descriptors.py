"""An object looks like itself from all sides, and its background has no say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.networks.onnx_graph import Graph
from mapstream.operators.networks.vlad import load_vocabulary
from mapstream.operators.objects.looks import MaskedCells, covered
from mapstream.operators.objects.object_descriptors import (
    ObjectDescriptors,
    ObjectDescriptorsConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.w_rgbd import START_NS, T_BASE_CAMERA, WRgbdConfig, rgbd_world
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.objects import ObjectDetections, window
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.networks.pictures import picture
from tests.operators.networks.weights import installed

pytestmark = pytest.mark.anyio

SIZE_PX = (192, 128)
BOX = (-0.5, -0.5, 95.5, 127.5)  # the left half


def frame(image: np.ndarray, stamp_ns: int = 1, name: str = "camera") -> CameraFrame:
    color = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
    return CameraFrame(stamp_ns=stamp_ns, image=color, encoding="rgb8", frame=name)


def objects(
    boxes: list[tuple[float, float, float, float]],
    masks: tuple[np.ndarray, ...] = (),
    stamp_ns: int = 1,
    name: str = "camera",
) -> ObjectDetections:
    return ObjectDetections(
        stamp_ns=stamp_ns,
        frame=name,
        width_px=SIZE_PX[0],
        height_px=SIZE_PX[1],
        boxes_px=np.array(boxes, np.float32).reshape(-1, 4),
        labels=("cup",) * len(boxes),
        scores=np.full(len(boxes), 0.9, np.float32),
        masks=masks,
        mask_sources=("model",) * len(masks),
    )


@pytest.fixture(scope="module")
def mean_color(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network whose vector is the mean colour."""
    graph = Graph("mean_color")
    image = graph.input("image", np.float32, [1, 3, "height", "width"])
    graph.output(
        "vector", graph.add("ReduceMean", image, axes=[2, 3], keepdims=0), np.float32, [1, 3]
    )
    file = tmp_path_factory.mktemp("networks") / "mean_color.onnx"
    file.write_bytes(graph.serialize())
    return file


@pytest.mark.slow
def test_J2_an_object_from_two_views_is_nearer_than_others() -> None:
    """W-RGBD: in at least 80 % of all triples of a thing, itself at least 3 s apart, and another thing."""
    installed("mobilenet_v2")
    camera = {"width_px": 640, "height_px": 480}
    world = rgbd_world(WRgbdConfig.model_validate({"camera": camera, "texel_m": 0.005}), 0)
    names = [thing.name for thing in world.room.things]
    owner_of = np.array(
        [names.index(s.name) if s.name in names else -1 for s in world.room.surfaces]
    )
    stamps_ns = START_NS + np.arange(1, 39, 3) * 1_000_000_000
    looks = MaskedCells(640)
    vectors, things, moments = [], [], []
    for stamp_ns, T in zip(stamps_ns, orbit(40.0, START_NS).poses(stamps_ns), strict=True):
        view = world.camera.ideal(T @ T_BASE_CAMERA.matrix)
        owner = np.where(view.surfaces < 0, -1, owner_of[view.surfaces])
        seen = [row for row in range(len(names)) if (owner == row).sum() > 400]
        if not seen:
            continue
        vectors.append(looks.vectors(view.image, masked(owner, seen)))
        things += seen
        moments += [stamp_ns] * len(seen)
    all_vectors, thing = np.concatenate(vectors), np.array(things)
    likeness = all_vectors @ all_vectors.T
    is_same = (thing[:, None] == thing) & (np.subtract.outer(moments, moments) != 0)
    wins = total = 0
    for row in range(len(thing)):
        same, other = likeness[row, is_same[row]], likeness[row, thing != thing[row]]
        wins += (same[:, None] > other).sum()
        total += same.size * other.size

    assert len(thing) > 40
    np.testing.assert_allclose(np.linalg.norm(all_vectors, axis=1), 1, atol=1e-5)
    assert wins / total >= 0.8


def masked(owner: np.ndarray, seen: list[int]) -> ObjectDetections:
    """Return the things that pixels (H, W) belong to as an ideal detector finds them."""
    boxes, masks = [], []
    for row in seen:
        rows, columns = np.nonzero(owner == row)
        box = (columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5)
        boxes.append(box)
        masks.append((owner == row)[window(np.array(box), owner.shape[1], owner.shape[0])])
    found = objects(boxes)
    height_px, width_px = owner.shape
    return replace(
        found,
        width_px=width_px,
        height_px=height_px,
        masks=tuple(masks),
        mask_sources=("model",) * len(masks),
    )


async def test_J2_background_counts_little() -> None:
    """What changes behind a mask changes its vector less than that of its box."""
    installed("mobilenet_v2")
    y, x = np.mgrid[:128, :96]
    mask = (x - 48) ** 2 + (y - 64) ** 2 < 40**2
    noise = np.random.default_rng(0).integers(0, 256, (128, 192)).astype(np.uint8)
    images = [picture(1), noise]
    images[1][:, :96][mask] = images[0][:, :96][mask]

    likeness = []
    for masks in ((mask,), ()):
        sent = await run_operator(
            ObjectDescriptors(ObjectDescriptorsConfig(long_side_px=384)),
            frames=[frame(images[0], 1), frame(images[1], 2)],
            detections=[objects([BOX], masks, 1), objects([BOX], masks, 2)],
        )
        a, b = (found.descriptors for found in sent["detections"])
        likeness.append((a @ b.T).item())

    assert likeness[0] > 0.6
    assert likeness[0] > likeness[1] + 0.1


async def test_a_users_network_sees_nothing_but_the_object(mean_color: Path) -> None:
    """The vector is that of the object's own colour and white, whatever is behind it."""
    mask = np.zeros((128, 96), np.bool_)
    mask[:64] = True
    image = np.random.default_rng(0).integers(0, 256, (128, 192, 3)).astype(np.uint8)
    image[:64, :96] = (255, 0, 0)
    config = ObjectDescriptorsConfig(model=mean_color)
    context = Context()

    sent = await run_operator(
        ObjectDescriptors(config),
        run_context=context,
        frames=[frame(image)],
        detections=[objects([BOX, BOX], (mask, np.zeros_like(mask)))],
    )

    (found,) = sent["detections"]
    assert found.descriptor_kind == "mean_color"
    np.testing.assert_allclose(found.descriptors[0], np.array([2, 1, 1]) / np.sqrt(6), atol=1e-5)
    assert np.isnan(found.descriptors[1]).all()
    assert context.activity.warnings == {"objects of camera too small for a descriptor": 1}


async def test_where_nothing_can_be_described_there_are_no_descriptors(mean_color: Path) -> None:
    empty = np.zeros((128, 96), np.bool_)

    sent = await run_operator(
        ObjectDescriptors(ObjectDescriptorsConfig(model=mean_color)),
        frames=[frame(np.zeros((128, 192, 3), np.uint8))],
        detections=[objects([BOX], (empty,))],
    )

    assert sent["detections"][0].descriptors is None


async def test_what_is_smaller_than_a_cell_has_no_descriptor() -> None:
    installed("mobilenet_v2")
    empty = np.zeros((128, 96), np.bool_)
    speck = np.ones((8, 8), np.bool_)
    boxes = [BOX, (99.5, 9.5, 107.5, 17.5), BOX]
    context = Context()

    sent = await run_operator(
        ObjectDescriptors(ObjectDescriptorsConfig(long_side_px=192)),
        run_context=context,
        frames=[frame(picture(1)), frame(picture(1), 2)],
        detections=[objects(boxes, (empty, speck, ~empty)), objects([], stamp_ns=2)],
    )

    found, nothing = sent["detections"]
    assert found.descriptors.shape == (3, load_vocabulary().width)
    assert np.isnan(found.descriptors[:2]).all()
    assert np.linalg.norm(found.descriptors[2]) == pytest.approx(1, abs=1e-5)
    assert len(nothing) == 0
    assert context.activity.warnings == {"objects of camera too small for a descriptor": 2}


async def test_each_camera_has_its_own_image(mean_color: Path) -> None:
    """Two cameras of one moment, in another order; and one whose image is missing."""
    colors = {"left": (200, 0, 0), "right": (0, 200, 0)}
    images = {name: np.full((128, 192, 3), color, np.uint8) for name, color in colors.items()}
    context = Context()

    sent = await run_operator(
        ObjectDescriptors(ObjectDescriptorsConfig(model=mean_color)),
        run_context=context,
        frames=[frame(images["left"], 5, "left"), frame(images["right"], 5, "right")],
        detections=[objects([BOX], (), 5, name) for name in ("right", "left", "rear")],
    )

    right, left, rear = sent["detections"]
    np.testing.assert_allclose(right.descriptors, [[0, 1, 0]])
    np.testing.assert_allclose(left.descriptors, [[1, 0, 0]])
    assert rear.descriptors is None
    assert context.activity.warnings == {
        "objects of rear without their image have no descriptors": 1
    }


async def test_images_of_another_size_are_refused(mean_color: Path) -> None:
    operator = ObjectDescriptors(ObjectDescriptorsConfig(model=mean_color))
    small = frame(np.zeros((64, 96, 3), np.uint8))

    with pytest.raises(OperatorError, match="expected images of 192 x 128 px"):
        await run_operator(operator, frames=[small], detections=[objects([BOX])])


def test_cells_are_covered_by_their_share() -> None:
    """The shares of all cells sum to the area of the mask, also on a grid that is no divisor of the image."""
    mask = cv2.circle(np.zeros((128, 96), np.uint8), (40, 50), 31, 1, cv2.FILLED) > 0
    boxes = [BOX, (95.5, -0.5, 191.5, 127.5)]

    shares = covered(objects(boxes, (mask, np.ones((128, 96), np.bool_))), (11, 7))

    cell_px = SIZE_PX[0] * SIZE_PX[1] / 77
    assert shares.sum(axis=1) * cell_px == pytest.approx([mask.sum(), 128 * 96], rel=1e-4)
    assert (shares.min(), shares.max()) == pytest.approx((0, 1), abs=1e-5)
