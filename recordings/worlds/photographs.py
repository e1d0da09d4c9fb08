"""Images as cameras record them: drawn, softened, with noise, and compressed; several at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Literal, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.recordings.worlds.paint import Picture

X = TypeVar("X")
Y = TypeVar("Y")

_THREADS = 2
_AHEAD = 8  # images that wait until the recording comes to them
_SOFTNESS_PX = 0.6  # of the lens
_NUM_NOISES = 4
_MARGIN_PX = 64  # noise is cut from larger ones, at random
Format = Literal["jpeg", "png"]


class Film:
    """Adds what an ideal image lacks. The noise depends on the image's number, not on who comes first."""

    def __init__(self, shape: tuple[int, ...], noise: float, seed: tuple[int, ...]) -> None:
        """Prepare for images of a shape, and a standard deviation [grey levels]."""
        rng = np.random.default_rng(seed)
        height, width, *channels = shape
        self._shape, self._seed = (height, width), seed
        whole = (_NUM_NOISES, height + _MARGIN_PX, width + _MARGIN_PX, *channels)
        self._noises = np.rint(rng.normal(0, noise, whole)).astype(np.int16)

    def expose(self, image: Picture, number: int) -> Picture:
        """Soften an image and add noise."""
        rng = np.random.default_rng((*self._seed, number))
        which, y, x = rng.integers(0, [_NUM_NOISES, _MARGIN_PX, _MARGIN_PX]).tolist()
        noise = self._noises[which, y : y + self._shape[0], x : x + self._shape[1]]
        soft = cv2.GaussianBlur(image, (3, 3), _SOFTNESS_PX)
        exposed = cv2.add(soft, noise, dtype=cv2.CV_8U)
        return exposed.astype(np.uint8, copy=False)


def compress(image: Picture, kind: Format, quality: int) -> npt.NDArray[np.uint8]:
    """Return the bytes (N,) of an image file."""
    if kind == "png":
        _, content = cv2.imencode(".png", image)
    else:
        _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return content.ravel().astype(np.uint8, copy=False)


def in_order(make: Callable[[X], Y], items: Iterable[X]) -> Iterator[Y]:
    """Yield `make` of each item, in their order, made by a few threads a little ahead."""
    waiting: deque[Future[Y]] = deque()
    with _one_thread_each(), ThreadPoolExecutor(_THREADS, thread_name_prefix="world") as pool:
        for item in items:
            waiting.append(pool.submit(make, item))
            if len(waiting) > _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let OpenCV use no threads of its own: beside ours they wait for each other, and cost a half more."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
