"""Objects that another program found in images: checked, and let in.

The messages are described in `docs/objects.md`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from pydantic import Field

from mapstream.operators.objects.detectors.class_tables import read_names
from mapstream.operators.objects.empty_masks import without_empty_masks
from mapstream.operators.objects.rows import rows_of
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    OptionalPath,
    report_loss,
    warn,
)
from mapstream.recordings.detection_checks import detection_faults, object_faults
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import rotation_from_quat_xyzw
from mapstream.streams.messages.objects import ObjectDetections

_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # of a box, by its sides


class ExternalDetectionsConfig(OperatorConfig):
    """Options of `external_detections`."""

    class_names: OptionalPath = None
    """A text file with the name of one class a line, the first of number 0, where labels are numbers."""
    classes: tuple[str, ...] = ()
    """Classes that are let in, if not all."""
    min_score: float = Field(default=0.0, ge=0.0, le=1.0)


@dataclass(frozen=True)
class Inputs:
    """Of any cameras, also mixed."""

    detections: Receiver[ObjectDetections]


@dataclass(frozen=True)
class Outputs:
    """The same messages, less what cannot be used."""

    detections: Sender[ObjectDetections]


class ExternalDetections(Operator[Inputs, Outputs]):
    """Let in objects that another program found.

    Objects in 3D alone get the box in which their camera sees them.
    What cannot be used is left out and counted by its reason; `mapstream doctor` gives the same reasons.
    """

    def __init__(self, config: ExternalDetectionsConfig) -> None:
        self._config = config
        self._names: tuple[str, ...] = ()

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._config.class_names is not None:
            self._names = read_names(self._config.class_names)
        async for detections in inputs.detections:
            faults = detection_faults(detections)
            for fault in faults:
                report_loss(f"objects of {detections.frame}: {fault}")
            if faults:
                outputs.detections.advance(detections.stamp_ns)
            else:
                await outputs.detections.send(self.checked(detections))

    def checked(self, detections: ObjectDetections) -> ObjectDetections:
        """Return what can be used of a message, and is wanted."""
        whole = self._named(_seen(detections))
        is_used = np.ones(len(whole), bool)
        for reason, rows in object_faults(whole).items():
            for _ in range(int(rows.sum())):
                report_loss(f"objects of {whole.frame}: {reason}")
            is_used &= ~rows
        config = self._config
        is_used &= whole.scores >= config.min_score
        if config.classes:
            is_used &= np.isin(whole.labels, config.classes)
        return without_empty_masks(rows_of(whole, is_used))

    def _named(self, detections: ObjectDetections) -> ObjectDetections:
        """Return the objects with names in the place of numbers."""
        if not self._names:
            return detections
        return replace(detections, labels=tuple(map(self._name, detections.labels)))

    def _name(self, label: str) -> str:
        if not label.isdecimal():
            return label
        if int(label) < len(self._names):
            return self._names[int(label)]
        warn(f"objects of class {label}, which is not among the {len(self._names)} names")
        return label


def _seen(detections: ObjectDetections) -> ObjectDetections:
    """Return the objects in an image whose size is known, with boxes that end there."""
    camera = detections.camera
    width_px, height_px = detections.width_px, detections.height_px
    boxes_px = detections.boxes_px.astype(np.float64)
    if camera is not None:
        width_px, height_px = camera.width_px, camera.height_px
        for row in np.flatnonzero(np.isnan(boxes_px).any(axis=1)):
            boxes_px[row] = _projected(detections, int(row), camera)
    return replace(
        detections,
        width_px=width_px,
        height_px=height_px,
        boxes_px=_cut(boxes_px, width_px, height_px).astype(np.float32),
    )


def _cut(boxes_px: FloatArray, width_px: int, height_px: int) -> FloatArray:
    """Return boxes (N, 4) that end with the image; those beside it stay, to be told of."""
    limit = np.array([width_px, height_px]) - 0.5
    is_beside = (boxes_px[:, 2:] <= -0.5) | (boxes_px[:, :2] >= limit)
    cut = np.clip(boxes_px, -0.5, np.tile(limit, 2))
    return np.where(is_beside.any(axis=1, keepdims=True), boxes_px, cut)


def _projected(detections: ObjectDetections, row: int, camera: CameraCalibration) -> FloatArray:
    """Return the box (4,) around an object's corners in the image; NaN if it is not before the camera."""
    if detections.centers_m is None or detections.extents_m is None:
        return np.full(4, np.nan)
    corners = _CORNERS * detections.extents_m[row]
    quats = detections.quats_camera_object_xyzw
    if quats is not None and np.isfinite(quats[row]).all():
        corners = corners @ rotation_from_quat_xyzw(quats[row]).T
    points = corners + detections.centers_m[row]
    if not (points[:, 2] > 0).all():
        return np.full(4, np.nan)
    px, has_pixel = project(camera, points)
    if not has_pixel.any():
        return np.full(4, np.nan)
    return np.concatenate([px[has_pixel].min(axis=0), px[has_pixel].max(axis=0)])
