"""Small detectors in files, whose outputs are known: those given, whatever the image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.onnx_graph import Graph

YOLOX_CELLS = 42  # of an image of 64 x 32 px: 8 x 4, 4 x 2 and 2 x 1
YOLOV8_CELLS = 84  # of an image of 64 x 64 px: 8 x 8, 4 x 4 and 2 x 2


def detector_file(
    folder: Path,
    outputs: Mapping[str, npt.NDArray[np.generic]],
    image: Sequence[int | str],
    metadata: Mapping[str, str] | None = None,
    dtype: npt.DTypeLike = np.float32,
) -> Path:
    """Write a network that gives the same for every image, which it takes as numbers of a type."""
    graph = Graph("detector")
    graph.input("images", dtype, image)
    for name, value in outputs.items():
        graph.output(name, graph.add("Identity", value), value.dtype, value.shape)
    for key, text in (metadata or {}).items():
        graph.describe(key, text)
    file = folder / "detector.onnx"
    file.write_bytes(graph.serialize())
    return file


def yolox_rows(num_classes: int = 3) -> npt.NDArray[np.float32]:
    """Return the rows (cells, 5 + classes) of a YOLOX that finds nothing."""
    return np.zeros((YOLOX_CELLS, 5 + num_classes), np.float32)


def yolox_file(folder: Path, rows: npt.NDArray[np.float32], **metadata: str) -> Path:
    """Write a YOLOX for images of 64 x 32 px with rows (cells, 5 + classes)."""
    return detector_file(folder, {"output": rows[None]}, [1, 3, 32, 64], metadata)


def bright_yolox_file(folder: Path, batch: int | str) -> Path:
    """Write a YOLOX that finds something of one class if an image is bright: its score is the mean of the values."""
    graph = Graph("bright")
    image = graph.input("images", np.float32, [batch, 3, 32, 64])
    mean = graph.add("ReduceMean", image, axes=[1, 2, 3], keepdims=1)
    score = graph.add(
        "Div", graph.add("Reshape", mean, np.array([-1, 1, 1])), np.array(255, np.float32)
    )
    one, sure = np.zeros((2, 1, YOLOX_CELLS, 6), np.float32)
    one[0, 0, 4] = 1.0
    sure[0, 0, 5] = 1.0
    rows = graph.add("Add", graph.add("Mul", score, one), sure)
    graph.output("output", rows, np.float32, [batch, YOLOX_CELLS, 6])
    graph.describe("names", "['light']")
    file = folder / "bright.onnx"
    file.write_bytes(graph.serialize())
    return file


def yolov8_file(
    folder: Path,
    found: Sequence[tuple[Sequence[float], int, float, Sequence[float]]],
    prototypes: npt.NDArray[np.float32] | None,
    **metadata: str,
) -> Path:
    """Write a YOLOv8 of three classes for images of 64 x 64 px.

    Args:
        folder: Where it is written.
        found: Middle and sides [px], class, score and coefficients of each thing.
        prototypes: Shape (M, h, w); None: no masks.
        metadata: What the file says of itself.
    """
    num_masks = 0 if prototypes is None else len(prototypes)
    table = np.zeros((4 + 3 + num_masks, YOLOV8_CELLS), np.float32)
    for column, (box, number, score, coefficients) in enumerate(found):
        table[:4, column] = box
        table[4 + number, column] = score
        table[7:, column] = coefficients[:num_masks]
    outputs: dict[str, npt.NDArray[np.generic]] = {"output0": table[None]}
    if prototypes is not None:
        outputs["output1"] = prototypes[None]
    names = {"names": "{0: 'person', 1: 'cup', 2: 'chair'}", **metadata}
    return detector_file(folder, outputs, [1, 3, 64, 64], names)
