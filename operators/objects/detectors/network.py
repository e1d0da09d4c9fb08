"""A detector in a file of the user's, whatever its layout."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np

from mapstream.operators.networks.sessions import Session
from mapstream.operators.objects.detectors import fastest_det, mask_rcnn, yolov8, yolox
from mapstream.operators.objects.detectors.candidates import Candidates
from mapstream.operators.objects.detectors.class_tables import class_table
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Layout, Outputs, Probe
from mapstream.streams.arrays import Float32Array
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.messages.sensors import CameraFrame

LayoutName = Literal["auto", "yolox", "yolov8", "mask_rcnn", "fastestdet"]
_CHANNELS = 3


class _Adapter(Protocol):
    """A module that knows one kind of network."""

    EXPECTED: str

    def layout(self, probe: Probe) -> Layout | None: ...


_ADAPTERS: Final[dict[str, _Adapter]] = {
    "yolox": yolox,
    "yolov8": yolov8,
    "mask_rcnn": mask_rcnn,
    "fastestdet": fastest_det,
}


class DetectorNetwork:
    """Finds objects in images; threads may share it.

    Args:
        file: An ONNX file.
        layout: Its kind; `auto`: the one that fits what it gives for an empty image.
        class_names: A text file with the names of its classes.
        side_px: Of its square image, where the file leaves that open and says nothing itself.

    Raises:
        ConfigError: If the file is no such network, or its classes have no names.
    """

    def __init__(
        self, file: Path, layout: LayoutName, class_names: Path | None, side_px: int
    ) -> None:
        self._session = Session(file, file.name)
        self._input, self._shape = _image_input(self._session)
        height, width = (
            side if isinstance(side, int) else own
            for side, own in zip(self._shape[-2:], _sides_px(self._session, side_px), strict=True)
        )
        self._size_px = width, height
        self.layout = self._told(layout)
        self.classes = class_table(
            self._session.name, class_names, self._session.metadata, self.layout.num_classes
        )

    def find(self, frames: Sequence[CameraFrame], least_score: float) -> list[Candidates]:
        """Return the candidates of each image, in one batch where the file allows.

        Raises:
            OperatorError: If the network cannot be run, or gives what its layout does not have.
        """
        batch = self._shape[0] if len(self._shape) == 4 else 1
        at_once = batch if isinstance(batch, int) else max(len(frames), 1)
        if self.layout.keeps_size:
            at_once = 1
        found = []
        for first in range(0, len(frames), at_once):
            found += self._in_one_run(frames[first : first + at_once], at_once, least_score)
        return found

    def _in_one_run(
        self, frames: Sequence[CameraFrame], batch: int, least_score: float
    ) -> list[Candidates]:
        layout = self.layout
        sizes_px = [(frame.image.shape[1], frame.image.shape[0]) for frame in frames]
        keeps_size = layout.keeps_size and not any(isinstance(n, int) for n in self._shape[-2:])
        width, height = sizes_px[0] if keeps_size else self._size_px
        fits = [ImageFit.of(size_px, (width, height), layout.fit) for size_px in sizes_px]
        planes = np.empty((batch, _CHANNELS, height, width), np.float32)
        planes[len(frames) :] = 0.0  # of a batch that is not full
        for frame, fit, plane in zip(frames, fits, planes, strict=False):
            fit.planes(frame, plane, is_rgb=layout.is_rgb, pad=layout.pad)
        if layout.most != 255.0:
            planes *= layout.most / 255.0
        outputs = self._run(planes)
        return [
            layout.read(self._of_image(outputs, row), fit, least_score)
            for row, fit in enumerate(fits)
        ]

    def _of_image(self, outputs: Outputs, row: int) -> Outputs:
        if self.layout.keeps_size:  # there is no batch
            return outputs
        return {name: array[row] for name, array in outputs.items()}

    def _run(self, planes: Float32Array) -> Outputs:
        given = planes if len(self._shape) == 4 else planes[0]
        found = self._session.run({self._input: given})
        return {n: a.astype(np.float32) if a.dtype == np.float16 else a for n, a in found.items()}

    def _told(self, wanted: LayoutName) -> Layout:
        """Return the layout of the network, by what it gives for an empty image."""
        batch = self._shape[0] if len(self._shape) == 4 and isinstance(self._shape[0], int) else 1
        width, height = self._size_px
        try:
            outputs = self._run(np.zeros((batch, _CHANNELS, height, width), np.float32))
        except OperatorError as error:
            raise ConfigError(f"no detector of images: {error}") from error
        probe = Probe(outputs, self._size_px)
        names = [wanted] if wanted != "auto" else list(_ADAPTERS)
        found = [layout for name in names if (layout := _ADAPTERS[name].layout(probe)) is not None]
        if not found:
            expected = "; ".join(f"{name}: {_ADAPTERS[name].EXPECTED}" for name in names)
            shapes = {name: array.shape for name, array in outputs.items()}
            raise ConfigError(
                f"{self._session.name}: no layout of a detector that is known: for an image of {width} x {height}"
                f" px it gives {shapes}; expected {expected}"
            )
        return found[0]


def _image_input(session: Session) -> tuple[str, tuple[int | str | None, ...]]:
    inputs = list(session.inputs.items())
    if len(inputs) == 1:
        name, shape = inputs[0]
        if len(shape) in (3, 4) and (shape[-3] == _CHANNELS or not isinstance(shape[-3], int)):
            return name, shape
    raise ConfigError(
        f"{session.name}: expected one input, an image (B, 3, H, W) or (3, H, W), found {dict(inputs)}"
    )


def _sides_px(session: Session, side_px: int) -> tuple[int, int]:
    """Return height and width of the image, as Ultralytics writes them into a file."""
    try:
        height, width = ast.literal_eval(session.metadata.get("imgsz", ""))
        return int(height), int(width)
    except (ValueError, SyntaxError, TypeError):
        return side_px, side_px
