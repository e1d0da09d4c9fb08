"""Descriptors and tracks of objects: `python benchmarks/object_tracks.py`.

Twenty objects of five classes move across an image of 640 x 480 px, with the 1536 numbers of the default descriptor and
galleries that are full, and without descriptors. Descriptors are of masks a tenth of the image wide, after the one pass
of MobileNetV2, whose time is told beside them. Times are the processor's, of short rounds of which the best counts:
other work on the machine only adds to it. Without the weights (`mapstream models install mobilenet_v2`) there are no
rows of descriptors.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.objects.looks import MaskedCells
from mapstream.operators.objects.tracking.object_tracker import ObjectTracker, ObjectTrackerConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.objects import ObjectDetections, window

_SIZE_PX = np.array([640, 480])
_NUMBERS = 1536
_PERIOD_NS = 33_000_000
_TARGET_HZ, _TARGET_S = 500, 1e-3


def _images(num_objects: int, count: int, *, is_described: bool) -> list[ObjectDetections]:
    """Return objects that swing about where they are, and what they look like from image to image."""
    rng = np.random.default_rng(0)
    middle = rng.uniform(50, _SIZE_PX - 50, (num_objects, 2))
    speed = rng.normal(0, 30, (num_objects, 2))
    half = rng.uniform(15, 45, (num_objects, 2))
    looks = _unit(rng.normal(size=(num_objects, _NUMBERS)))
    found = []
    for i in range(count):
        at = middle + speed * np.sin(i / 30) + rng.normal(0, 1, middle.shape)
        seen = _unit(looks + rng.normal(0, 0.6 / np.sqrt(_NUMBERS), looks.shape))
        found.append(
            ObjectDetections(
                stamp_ns=1 + i * _PERIOD_NS,
                frame="color",
                width_px=640,
                height_px=480,
                boxes_px=np.hstack([at - half, at + half]).astype(np.float32),
                labels=tuple(f"class {row % 5}" for row in range(num_objects)),
                scores=np.full(num_objects, 0.9, np.float32),
                descriptors=seen.astype(np.float32) if is_described else None,
            )
        )
    return found


def _unit(rows: FloatArray) -> FloatArray:
    unit: FloatArray = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return unit


def _best_s(call: Callable[[], object], rounds: int) -> float:
    """Return the least processor time of a call."""
    times = []
    for _ in range(rounds):
        started = time.process_time()
        call()
        times.append(time.process_time() - started)
    return min(times)


def _tracker(num_objects: int, *, is_described: bool, bar: str) -> Row:
    images = _images(num_objects, 130 if num_objects < 100 else 10, is_described=is_described)
    tracker = ObjectTracker(ObjectTrackerConfig())
    steady = len(images) * 8 // 10  # until there are no new tracks, and the galleries are full
    for image in images[:steady]:
        tracker.track(image)
    rest = iter(images[steady:])
    seconds = _best_s(lambda: tracker.track(next(rest)), len(images) - steady)
    looks = f"{_NUMBERS} numbers each" if is_described else "no descriptors"
    return Row(
        what=f"tracker, {num_objects} objects, {looks}",
        ours=f"{1 / seconds:.0f} images/s",
        other=f"{_TARGET_HZ} images/s",
        ratio=1 / seconds / _TARGET_HZ,
        bar=bar,
    )


def _descriptors(num_objects: int) -> Row:
    """Return the time of each object's descriptor beyond that of the image's pass."""
    looks, rng = MaskedCells(640), np.random.default_rng(0)
    image = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    low = rng.uniform(0, _SIZE_PX - 64, (num_objects, 2))
    boxes = np.hstack([low, low + 64]).astype(np.float32)
    shapes = [tuple(part.stop - part.start for part in window(box, 640, 480)) for box in boxes]
    found = ObjectDetections(
        stamp_ns=1,
        frame="color",
        width_px=640,
        height_px=480,
        boxes_px=boxes,
        labels=("cup",) * num_objects,
        scores=np.ones(num_objects, np.float32),
        masks=tuple(rng.random(shape) < 0.7 for shape in shapes),
    )
    pass_s = _best_s(lambda: looks.cells(image), 5)
    cells, grid = looks.cells(image), looks.cells.grid(image)
    each_s = _best_s(lambda: looks.vectors_of(cells, grid, found), 20) / num_objects
    return Row(
        what=f"descriptor, each of {num_objects} objects after the pass of {pass_s * 1e3:.0f} ms",
        ours=f"{each_s * 1e3:.2f} ms",
        other=f"{_TARGET_S * 1e3:g} ms",
        ratio=each_s / _TARGET_S,
        bar="at most 1",
    )


def run() -> Sequence[Row]:
    cv2.setNumThreads(1)
    rows = [
        _tracker(20, is_described=True, bar="at least 1"),
        _tracker(20, is_described=False, bar="at least 1"),
        _tracker(500, is_described=True, bar=""),
    ]
    try:
        return [*rows, _descriptors(20)]
    except ConfigError as error:
        print(error)
        return rows


if __name__ == "__main__":
    print(markdown(run()))
