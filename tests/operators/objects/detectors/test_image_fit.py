"""Images come into the network's size and order, boxes back into the image's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.objects.detectors.image_fit import FitMode, ImageFit
from mapstream.operators.objects.detectors.suppression import distinct
from mapstream.streams.messages.sensors import CameraFrame

_SIZES = st.tuples(st.integers(16, 900), st.integers(16, 900))
_MODES = st.sampled_from(["corner", "middle", "stretch"])


def frame(image: np.ndarray, encoding: str) -> CameraFrame:
    return CameraFrame(stamp_ns=1, image=image, encoding=encoding, frame="left")


@given(size_px=_SIZES, network_px=_SIZES, mode=_MODES)
def test_the_whole_image_comes_back_whole(
    size_px: tuple[int, int], network_px: tuple[int, int], mode: FitMode
) -> None:
    fit = ImageFit.of(size_px, network_px, mode)
    low = np.array(fit.offset_px)
    high = low + fit.inner_px

    assert (low >= 0).all()
    assert (high <= network_px).all()
    back = fit.boxes(np.array([[*low, *high], [*(low - 5), *(high + 5)]]))
    whole = [-0.5, -0.5, size_px[0] - 0.5, size_px[1] - 0.5]
    np.testing.assert_allclose(back, [whole, whole], atol=1e-3)


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8"])
@pytest.mark.parametrize("is_rgb", [True, False])
def test_channels_come_in_the_order_that_the_network_wants(encoding: str, *, is_rgb: bool) -> None:
    colors = {"b": 10.0, "g": 20.0, "r": 30.0}
    pixel = np.array([colors[name] for name in encoding[:3]], np.uint8)
    planes = np.empty((3, 8, 8), np.float32)
    fit = ImageFit.of((4, 8), (8, 8), "middle")

    fit.planes(frame(np.tile(pixel, (8, 4, 1)), encoding), planes, is_rgb=is_rgb, pad=114.0)

    expected = [colors[name] for name in ("rgb" if is_rgb else "bgr")]
    np.testing.assert_array_equal(planes[:, 3, 4], expected)
    np.testing.assert_array_equal(planes[:, :, [0, 1, 6, 7]], 114.0)
    assert (planes[:, :, 2:6] != 114.0).all()


def test_grey_images_are_grey_in_all_channels() -> None:
    planes = np.empty((3, 4, 4), np.float32)
    image = np.full((8, 8), 77, np.uint8)

    ImageFit.of((8, 8), (4, 4), "stretch").planes(
        frame(image, "mono8"), planes, is_rgb=True, pad=0.0
    )

    assert (planes == 77.0).all()


_BOXES = st.lists(
    st.tuples(*[st.integers(0, 30)] * 2, *[st.integers(1, 12)] * 2, st.integers(0, 1)), max_size=25
)


@given(boxes=_BOXES, limits=st.tuples(*[st.floats(0.0, 1.0)] * 2), seed=st.integers(0, 99))
def test_what_is_left_overlaps_little_and_what_went_overlapped_a_better_one(
    boxes: list[tuple[int, ...]], limits: tuple[float, float], seed: int
) -> None:
    table = np.array(boxes, np.float32).reshape(-1, 5)
    corners = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    classes = table[:, 4].astype(np.int64)
    scores = np.random.default_rng(seed).permutation(len(table)).astype(np.float32)

    kept = distinct(
        corners, scores, classes, max_overlap=limits[0], max_class_overlap=limits[1]
    ).tolist()

    def excess(a: int, b: int) -> float:
        low = np.maximum(corners[a, :2], corners[b, :2])
        high = np.minimum(corners[a, 2:], corners[b, 2:])
        shared = float(np.prod(np.maximum(high - low, 0)))
        areas = [float(np.prod(corners[i, 2:] - corners[i, :2])) for i in (a, b)]
        return shared / (sum(areas) - shared) - limits[int(classes[a] != classes[b])]

    assert scores[kept].tolist() == sorted(scores[kept], reverse=True)
    for row in range(len(table)):
        above = [excess(row, other) for other in kept if scores[other] > scores[row]]
        most = max(above, default=-1.0)
        assert (row in kept) == (most <= 0) or most == pytest.approx(0, abs=1e-12)
