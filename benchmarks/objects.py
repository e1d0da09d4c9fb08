"""Semantic mapping: `python benchmarks/objects.py`.

The detector operator on real images of 640 x 480 px, from the decoded image to checked objects, with its queues, threads
and messages, against onnxruntime alone on tensors that are ready. Both use one thread; times are the processor's, of
short rounds that take turns, and the best counts: other work on the machine only adds to it.
Networks and images are those beside the shared data; without them there are no rows.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.objects.object_detector import (
    ObjectDetector,
    ObjectDetectorConfig,
    ObjectFinder,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.sensors import CameraFrame

_SHARED = Path(__file__).parents[2] / "shared"
_IMAGES = _SHARED / "data" / "tum_fr3_office_objects" / "images_1hz"
_NETWORKS = {  # files, and what is asked for
    "YOLOX-nano": ("yolox_nano_416.onnx", "at most 1.1"),
    "FastestDet": ("fastestdet_352.onnx", ""),
}
_ROUNDS, _IN_ROUND = 30, 4


def _frames() -> list[CameraFrame]:
    images = [cv2.imread(str(path)) for path in sorted(_IMAGES.glob("*.png"))]
    return [
        CameraFrame(stamp_ns=i, image=np.asarray(image, np.uint8), encoding="bgr8", frame="color")
        for i, image in enumerate(images)
    ]


def _session(model: Path) -> tuple[Any, str, tuple[int, ...]]:
    """Return onnxruntime's own session, as the operator has it, with its input and the shape of that."""
    import onnxruntime  # noqa: PLC0415  # as the operator does

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    given = session.get_inputs()[0]
    return session, given.name, tuple(given.shape)


def _tensor(frame: CameraFrame, size_px: tuple[int, int]) -> Float32Array:
    """Return an image as a network's input, whose values are near enough for its time."""
    small = cv2.resize(frame.image, size_px)
    return np.ascontiguousarray(small.transpose(2, 0, 1)[None], np.float32)


def _detector(name: str, model: Path, frames: list[CameraFrame], bar: str) -> list[Row]:
    """Return the operator's time per image against that of the network alone."""
    session, given, (_, _, height, width) = _session(model)
    tensors = [_tensor(frame, (width, height)) for frame in frames]
    config = ObjectDetectorConfig(model=model)
    finder = ObjectFinder(config)
    alone, calls, whole = [], [], []
    for _ in range(_ROUNDS):
        started = time.process_time()
        for tensor in tensors:
            session.run(None, {given: tensor})
        alone.append((time.process_time() - started) / len(frames))
        started = time.process_time()
        for frame in frames:
            finder.find([frame])
        calls.append((time.process_time() - started) / len(frames))
        whole.append(anyio.run(_run, config, frames))
    alone_s = min(alone)
    return [
        Row(
            what=f"{name}, {what}",
            ours=f"{min(ours) * 1e3:.1f} ms",
            other=f"onnxruntime alone {alone_s * 1e3:.1f} ms",
            ratio=min(ours) / alone_s,
            bar=reach,
        )
        for what, ours, reach in (
            ("image to objects", calls, ""),
            ("the operator, in its thread", whole, bar),
        )
    ]


async def _run(config: ObjectDetectorConfig, frames: list[CameraFrame]) -> float:
    """Return the time per image of the operator, without that of opening the network."""
    operator = ObjectDetector(config)
    finder = ObjectFinder(config)
    operator.open = lambda: finder  # type: ignore[method-assign]  # opened before the clock starts
    context = Context(placement="thread")
    started = time.process_time()
    await run_operator(operator, config=config, run_context=context, frames=frames)
    return (time.process_time() - started) / len(frames)


def run() -> Sequence[Row]:
    cv2.setNumThreads(1)
    frames = _frames()[:_IN_ROUND]
    return [
        row
        for name, (file, bar) in _NETWORKS.items()
        if (_SHARED / "models" / file).is_file() and frames
        for row in _detector(name, _SHARED / "models" / file, frames, bar)
    ]


if __name__ == "__main__":
    print(markdown(run()))
