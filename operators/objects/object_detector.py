"""Objects found in images by a network in a file (the role of Mask R-CNN in maplab 2.0, section IV-D)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import anyio.to_thread
import cv2
import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveInt

from mapstream.operators.images.calibrated import fitted
from mapstream.operators.images.frame_filter import COLORS, require_encoding
from mapstream.operators.objects.detectors.candidates import Candidates
from mapstream.operators.objects.detectors.network import DetectorNetwork, LayoutName
from mapstream.operators.objects.detectors.suppression import distinct
from mapstream.operators.objects.empty_masks import without_empty_masks
from mapstream.operators.operator import (
    DynamicPorts,
    Operator,
    OperatorConfig,
    OptionalPath,
    Placement,
    Ports,
    offload,
    report_loss,
    warn,
)
from mapstream.operators.period import Period
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Sender
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.moments import moments


class ObjectDetectorConfig(OperatorConfig):
    """Options of `object_detector`; each name of `inputs` is an input of `CameraFrame`."""

    model: Path
    """An ONNX file."""
    layout: LayoutName = "auto"
    """What kind of network it is; `auto`: as the file itself tells."""
    class_names: OptionalPath = None
    """A text file with the name of one class a line, where neither the file has them nor they are COCO's."""
    inputs: tuple[str, ...] = Field(default=("frames",), min_length=1)
    """One for each camera. Images taken together go into the network together, if its file allows."""
    tolerance_s: NonNegativeFloat = 0.0005
    """How far images taken together may be apart."""
    period_s: NonNegativeFloat = 0.0
    """Of a camera, one image in so much time is looked at on average; 0: each."""
    min_score: float = Field(default=0.3, ge=0.0, le=1.0)
    min_scores: dict[str, float] = Field(default_factory=dict)
    """The same for some classes, by name."""
    max_overlap: float = Field(default=0.45, ge=0.0, le=1.0)
    """Of two boxes of a class that overlap more the better stays: what both cover as a share of what either does."""
    max_class_overlap: float = Field(default=0.85, ge=0.0, le=1.0)
    """The same for boxes of different classes, such as a car that is also taken for a truck."""
    classes: tuple[str, ...] = ()
    """Classes that are wanted, if not all."""
    max_detections: PositiveInt = 300
    """In an image; the best."""
    side_px: int = Field(default=640, ge=32)
    """Of the image that the network sees, where its file leaves that open."""


@dataclass(frozen=True)
class Outputs:
    """One message for each image that was looked at, even without an object."""

    detections: Sender[ObjectDetections]


class ObjectDetector(DynamicPorts, Operator[Ports, Outputs]):
    """Find objects in images: boxes, classes, scores, and masks where the network makes them.

    Networks are files of YOLOX, YOLOv8 or YOLO11 (with masks or without), torchvision's Mask R-CNN, or FastestDet.
    A mask without a pixel gives way to the box, and boxes that are not finite are left out; both are counted.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: ObjectDetectorConfig) -> None:
        self._config = config
        self._periods = [Period(config.period_s) for _ in config.inputs]

    @classmethod
    def ports_for(cls, config: ObjectDetectorConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return dict.fromkeys(config.inputs, CameraFrame), {}

    async def run(self, inputs: Ports, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        finder = await anyio.to_thread.run_sync(self.open)
        receivers = [inputs[name] for name in self._config.inputs]
        tolerance_ns = round(self._config.tolerance_s * 1e9)
        async for moment in moments(receivers, tolerance_ns):
            frames = [frame for port, frame in moment.items() if self._is_wanted(port, frame)]
            if not frames:
                outputs.detections.advance(next(iter(moment.values())).stamp_ns)
                continue
            for detections in await offload(finder.find, frames):
                await outputs.detections.send(detections)

    def _is_wanted(self, port: int, frame: CameraFrame) -> bool:
        require_encoding(frame, "object_detector", (*COLORS, "mono8", "mono16"))
        if not self._periods[port].begins(frame.stamp_ns):
            return False
        fits = fitted(frame, "drop")
        if isinstance(fits, str):
            report_loss(fits)
        return not isinstance(fits, str)

    def open(self) -> ObjectFinder:
        """Return the network, ready to run."""
        return ObjectFinder(self._config)


class ObjectFinder:
    """A network, and what is wanted of what it finds.

    Raises:
        ConfigError: If the file is no detector, or classes are asked for that it does not have.
    """

    def __init__(self, config: ObjectDetectorConfig) -> None:
        self._config = config
        self._network = DetectorNetwork(
            config.model, config.layout, config.class_names, config.side_px
        )
        self._least = self._least_scores()

    def find(self, frames: Sequence[CameraFrame]) -> list[ObjectDetections]:
        """Return the objects in each image, the best first."""
        found = self._network.find(frames, float(self._least.min()))
        return [self._chosen(*pair) for pair in zip(frames, found, strict=True)]

    def _chosen(self, frame: CameraFrame, found: Candidates) -> ObjectDetections:
        for _ in range(found.num_broken):
            report_loss(f"objects of {frame.frame} whose numbers are not finite")
        size_px = frame.image.shape[1], frame.image.shape[0]
        rows = self._best(frame, found)
        masks = found.masks_of(rows, size_px)
        chosen = ObjectDetections(
            stamp_ns=frame.stamp_ns,
            frame=frame.frame,
            width_px=size_px[0],
            height_px=size_px[1],
            boxes_px=found.boxes_px[rows],
            labels=tuple(self._network.classes[number] for number in found.classes[rows]),
            scores=np.minimum(found.scores[rows], 1.0),
            masks=masks,
            mask_sources=("model",) * len(masks),
            T_base_sensor=frame.T_base_sensor,
            camera=frame.camera,
            record=frame.record,
        )
        return without_empty_masks(chosen)

    def _best(self, frame: CameraFrame, found: Candidates) -> IntArray:
        """Return the rows of what is wanted, the best first."""
        classes, boxes = found.classes, found.boxes_px
        if len(classes) and not 0 <= classes.min() <= classes.max() < len(self._least):
            raise OperatorError(
                f"{self._config.model}: found a thing of class {classes.max()}, but there are names for"
                f" {len(self._least)}; give a text file with one a line as `class_names`"
            )
        has_area = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        wanted = np.flatnonzero(has_area & (found.scores >= self._least[classes]))
        config = self._config
        distinct_rows = distinct(
            boxes[wanted],
            found.scores[wanted],
            classes[wanted],
            max_overlap=config.max_overlap,
            max_class_overlap=config.max_class_overlap,
        )
        rows = wanted[distinct_rows]
        most = config.max_detections
        for _ in rows[most:]:
            warn(f"objects of {frame.frame} beyond the best {most} of an image (max_detections)")
        return rows[:most]

    def _least_scores(self) -> FloatArray:
        """Return the least score for each class, infinite for those that are not wanted."""
        config, names = self._config, self._network.classes
        asked = {*config.min_scores, *config.classes}
        unknown = sorted(asked - set(names))
        if unknown:
            raise ConfigError(
                f"{config.model}: knows no class {', '.join(unknown)}; it knows {', '.join(filter(None, names))}"
            )
        return np.array(
            [
                config.min_scores.get(name, config.min_score)
                if not config.classes or name in config.classes
                else np.inf
                for name in names
            ]
        )
