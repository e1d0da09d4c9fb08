"""Detected objects as keypoints, so that they go into a map as features do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.objects.certainty import (
    CertaintyOptions,
    center_sigmas_m,
    middle_sigmas_px,
)
from mapstream.operators.operator import Operator
from mapstream.streams.arrays import Float32Array
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import ImageFeatures

KIND = "object"


class ObjectFeaturesConfig(CertaintyOptions):
    """Options of `object_features`."""


@dataclass(frozen=True)
class Inputs:
    """Objects, best after `object_tracker`: what has no track makes no landmark."""

    detections: Receiver[ObjectDetections]


@dataclass(frozen=True)
class Outputs:
    """A keypoint for each object, of kind `object`."""

    features: Sender[ImageFeatures]


class ObjectFeatures(Operator[Inputs, Outputs]):
    """Make each object a keypoint: the middle of its box, with its 3D centre, descriptor and track."""

    def __init__(self, config: ObjectFeaturesConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for detections in inputs.detections:
            await outputs.features.send(self.features(detections))

    def features(self, detections: ObjectDetections) -> ImageFeatures:
        """Return the keypoints of one image's objects, in their order."""
        low, high = np.split(detections.boxes_px, 2, axis=1)
        sigmas_m = None
        if detections.centers_m is not None:
            sigmas_m = center_sigmas_m(detections, self._config).astype(np.float32)
        return ImageFeatures(
            stamp_ns=detections.stamp_ns,
            kind=KIND,
            frame=detections.frame,
            keypoints_px=((low + high) / 2).astype(np.float32),
            descriptors=_descriptors(detections),
            scores=detections.scores,
            scales=np.sqrt((high - low).clip(min=0).prod(axis=1)).astype(np.float32),
            sigmas_px=middle_sigmas_px(detections, self._config).astype(np.float32),
            track_ids=detections.track_ids,
            points_m=detections.centers_m,
            point_sigmas_m=sigmas_m,
            objects=detections,
            T_base_sensor=detections.T_base_sensor,
            camera=detections.camera,
            record=detections.record,
        )


def _descriptors(detections: ObjectDetections) -> Float32Array:
    """Return the descriptors (N, D); zeros where an object has none."""
    if detections.descriptors is None:
        return np.empty((len(detections), 0), np.float32)
    return np.nan_to_num(detections.descriptors, nan=0.0)
