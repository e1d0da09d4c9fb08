"""Text files of boxes that a detector found in an image: `class x_min y_min width height score` a line.

Boxes are in whole pixels from the image's corner, so that the middle of the first pixel is at half a pixel; the
class is a number of COCO. Files without classes are `x_min y_min width height score`, of objects of one kind.
"""

from __future__ import annotations

from pathlib import PurePath

import numpy as np

from mapstream.streams.coco import COCO_CLASSES
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.objects import ObjectDetections


def read_boxes(
    content: str,
    place: PurePath,
    stamp_ns: int,
    *,
    frame: str,
    size_px: tuple[int, int],
    label: str | None = None,
) -> ObjectDetections:
    """Read what was found in one image.

    Args:
        content: The text; none at all means that nothing was found.
        place: Where it is from, for errors.
        stamp_ns: Of the image.
        frame: Of the camera.
        size_px: Width and height of the image; boxes end there.
        label: The kind of all objects, where lines have no class.

    Raises:
        RecordingError: If a line is not what it should be; with the line.
    """
    lines = content.splitlines()
    rows = [_row(line, f"{place}:{n}", label) for n, line in enumerate(lines, 1) if line.strip()]
    numbers = np.array([values for _, values in rows], np.float64).reshape(-1, 5)
    least = numbers[:, :2] - 0.5
    limit = np.array([*size_px, *size_px]) - 0.5
    boxes_px = np.clip(np.hstack([least, least + numbers[:, 2:4]]), -0.5, limit)
    return ObjectDetections(
        stamp_ns=stamp_ns,
        frame=frame,
        width_px=size_px[0],
        height_px=size_px[1],
        boxes_px=boxes_px.astype(np.float32),
        labels=tuple(name for name, _ in rows),
        scores=numbers[:, 4].astype(np.float32),
    )


def _row(line: str, place: str, label: str | None) -> tuple[str, list[float]]:
    expected = "x_min y_min width height score"
    words = line.split()
    try:
        values = [float(word) for word in words]
        name = COCO_CLASSES[int(words[0])] if label is None else label
    except (ValueError, IndexError) as error:
        raise RecordingError(f"{place}: expected numbers, found {line!r}: {error}") from error
    numbers = values[1:] if label is None else values
    if len(numbers) != 5 or not np.isfinite(numbers).all() or min(numbers[2:4]) <= 0:
        wanted = expected if label else f"class {expected}"
        raise RecordingError(f"{place}: expected {wanted}, found {line!r}")
    return name, numbers
