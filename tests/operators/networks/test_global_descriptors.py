"""Images of one place have vectors that are alike."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapstream.operators.networks.global_descriptors import (
    GlobalDescriptors,
    GlobalDescriptorsConfig,
)
from mapstream.operators.networks.onnx_graph import Graph
from mapstream.operators.networks.vlad import learn_vocabulary, load_vocabulary
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage
from tests.operators.networks.files import superpoint_file
from tests.operators.networks.pictures import picture
from tests.operators.networks.weights import installed

pytestmark = pytest.mark.anyio

FLIGHT = {
    "cameras": ["left"],
    "camera": {"width_px": 320, "height_px": 240, "rate_hz": 0.75},
    "flight": {"duration_s": 60.0},  # two laps of 28 s
    "texel_m": 0.02,
}
APART_NS = 10_000_000_000


def _frame(image: np.ndarray, stamp_ns: int = 1, encoding: str = "mono8") -> CameraFrame:
    return CameraFrame(stamp_ns=stamp_ns, image=image, encoding=encoding, frame="left")


@pytest.mark.slow
async def test_H17_a_place_seen_before_is_among_the_five_most_alike() -> None:
    """W-VI, two laps: of the images with an earlier one within 2 m and 30 degrees, 90 % find one among five."""
    installed("mobilenet_v2")
    frames, truth = [], []
    for record in w_vi(WViConfig.model_validate(FLIGHT), 0).records:
        message = record.message
        if isinstance(message, EncodedImage):
            image = np.asarray(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE), np.uint8)
            frames.append(
                CameraFrame(
                    stamp_ns=message.stamp_ns,
                    image=image,
                    encoding="mono8",
                    frame=message.frame,
                    T_base_sensor=message.T_base_sensor,
                )
            )
        elif record.topic == "/truth" and isinstance(message, Odometry):
            truth.append(message)

    operator = GlobalDescriptors(GlobalDescriptorsConfig())
    found = (await run_operator(operator, frames=frames))["descriptors"]

    truth_ns = np.array([pose.stamp_ns for pose in truth])
    stamps_ns = np.array([frame.stamp_ns for frame in frames])
    poses = np.array(
        [
            (
                truth[np.abs(truth_ns - frame.stamp_ns).argmin()].T_odom_base @ frame.T_base_sensor
            ).matrix
            for frame in frames
        ]
    )
    vectors = np.array([descriptor.vector for descriptor in found])
    is_earlier = stamps_ns[:, None] - stamps_ns >= APART_NS
    distance_m = np.linalg.norm(poses[:, None, :3, 3] - poses[:, :3, 3], axis=2)
    cosines = poses[:, :3, 2] @ poses[:, :3, 2].T
    is_same = is_earlier & (distance_m < 2) & (cosines > np.cos(np.radians(30)))
    likeness = np.where(is_earlier, vectors @ vectors.T, -1)
    best = np.argsort(-likeness, axis=1)[:, :5]
    queries = is_same.any(axis=1)
    hits = np.take_along_axis(is_same, best, axis=1)[queries]
    assert queries.sum() >= 20
    assert hits.any(axis=1).mean() >= 0.9


async def test_vectors_have_unit_length_and_hardly_depend_on_the_light() -> None:
    installed("mobilenet_v2")
    image = picture(7)
    darker = (image * 0.7).astype(np.uint8)
    color = np.repeat(image[..., None], 3, axis=2)
    frames = [
        _frame(image, 1),
        _frame(darker, 2),
        _frame(picture(8), 3),
        _frame(color, 4, "bgr8"),
        _frame(color, 5, "rgb8"),
    ]

    sent = await run_operator(GlobalDescriptors(GlobalDescriptorsConfig()), frames=frames)

    same, dark, other, *colored = [descriptor.vector for descriptor in sent["descriptors"]]
    assert {descriptor.kind for descriptor in sent["descriptors"]} == {"mobilenet_v2_vlad"}
    assert same.shape == (load_vocabulary().width,)
    np.testing.assert_allclose(np.linalg.norm(same), 1, atol=1e-5)
    assert same @ dark > same @ other + 0.05, (same @ dark, same @ other)
    for vector in colored:
        np.testing.assert_allclose(vector, same, atol=1e-5)


@pytest.mark.parametrize("is_planar", [True, False])
async def test_a_users_network_makes_the_vector(tmp_path: Path, *, is_planar: bool) -> None:
    graph = Graph("mean_color")
    image = (
        graph.input("image", np.float32, [1, 3, "height", "width"])
        if is_planar
        else graph.input("image", np.uint8, [1, 32, 64, 3])
    )
    numbers = graph.add("Cast", image, to=1)
    mean = graph.add("ReduceMean", numbers, axes=[2, 3] if is_planar else [1, 2], keepdims=0)
    graph.output("embedding", mean, np.float32, [1, 3])
    file = tmp_path / "mean_color.onnx"
    file.write_bytes(graph.serialize())
    red = np.zeros((96, 128, 3), np.uint8)
    red[..., 2], red[..., 1], red[0] = 200, 150, 0  # blue first, and a row that is black
    operator = GlobalDescriptors(GlobalDescriptorsConfig(model=file))

    (found,) = (await run_operator(operator, frames=[_frame(red, 1, "bgr8")]))["descriptors"]

    assert found.kind == "mean_color"
    np.testing.assert_allclose(found.vector, [0.8, 0.6, 0], atol=1e-2)


async def test_images_too_soon_and_without_content_are_passed_over() -> None:
    installed("mobilenet_v2")
    black = np.zeros((64, 64), np.uint8)
    images = [picture(1), picture(2), black, picture(3)]
    frames = [_frame(image, i * 400_000_000) for i, image in enumerate(images)]
    frames[2] = _frame(black, 1_000_000_000)
    frames[3] = _frame(picture(3), 2_000_000_000)
    context = Context()
    config = GlobalDescriptorsConfig(period_s=1.0)

    sent = await run_operator(GlobalDescriptors(config), run_context=context, frames=frames)

    assert [d.stamp_ns for d in sent["descriptors"]] == [0, 2_000_000_000]
    assert list(context.activity.warnings) == ["images of left of one colour have no descriptor"]


def test_files_with_other_ends_are_refused(tmp_path: Path) -> None:
    file = superpoint_file(tmp_path)
    with pytest.raises(ConfigError, match="expected one input, an image"):
        GlobalDescriptors(GlobalDescriptorsConfig(model=file)).open()
    with pytest.raises(ConfigError, match="no vocabulary"):
        load_vocabulary(file)


def test_a_vocabulary_comes_back_from_its_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    cells = (rng.normal(size=(500, 6)) * [1, 2, 3, 4, 5, 6]).astype(np.float32)
    made = learn_vocabulary(cells, 4, 3)

    made.save(tmp_path / "words.npz")

    kept = load_vocabulary(tmp_path / "words.npz")
    assert kept.width == 12
    np.testing.assert_array_equal(kept.vector(cells[:50]), made.vector(cells[:50]))
