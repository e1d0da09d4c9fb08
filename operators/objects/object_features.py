"""Detected objects as keypoints, so that they go into a map as features do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.landmarks.views import POINT_SIGMA_M
from mapstream.operators.operator import Operator, OperatorConfig
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import ImageFeatures

KIND = "object"


class ObjectFeaturesConfig(OperatorConfig):
    """Options of `object_features`."""

    sigma_share: PositiveFloat = 0.05
    """Uncertainty of the middle of an object, as a share of its box's longer side."""
    least_sigma_px: PositiveFloat = 1.0
    cut_sigma_share: PositiveFloat = 0.5
    """The same where the border of the image cuts the object: its middle may be far from the box's."""
    border_px: NonNegativeFloat = 2.0
    """An object whose box is so near to the border of the image counts as cut."""


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
        boxes = detections.boxes_px.astype(np.float64)
        sides_px = boxes[:, 2:] - boxes[:, :2]
        is_cut = self.is_cut(detections)
        return ImageFeatures(
            stamp_ns=detections.stamp_ns,
            kind=KIND,
            frame=detections.frame,
            keypoints_px=_f4((boxes[:, :2] + boxes[:, 2:]) / 2),
            descriptors=_descriptors(detections),
            scores=detections.scores,
            scales=_f4(np.sqrt(sides_px.clip(min=0).prod(axis=1))),
            sigmas_px=_f4(self._sigmas_px(sides_px, is_cut)),
            track_ids=detections.track_ids,
            points_m=detections.centers_m,
            point_sigmas_m=self._sigmas_m(detections, sides_px, is_cut),
            objects=detections,
            T_base_sensor=detections.T_base_sensor,
            camera=detections.camera,
            record=detections.record,
        )

    def is_cut(self, detections: ObjectDetections) -> BoolArray:
        """Return which objects (N,) the border of the image cuts, or may cut."""
        last_px = np.array([detections.width_px, detections.height_px]) - 0.5
        boxes, border_px = detections.boxes_px, self._config.border_px
        low, high = boxes[:, :2] < border_px - 0.5, boxes[:, 2:] > last_px - border_px
        is_cut: BoolArray = np.asarray((low | high).any(axis=1))
        return is_cut

    def _sigmas_px(self, sides_px: FloatArray, is_cut: BoolArray) -> FloatArray:
        config = self._config
        share = np.where(is_cut, config.cut_sigma_share, config.sigma_share)
        sigmas_px: FloatArray = share * sides_px.max(axis=1, initial=0)
        return np.maximum(sigmas_px, config.least_sigma_px)

    def _sigmas_m(
        self, detections: ObjectDetections, sides_px: FloatArray, is_cut: BoolArray
    ) -> Float32Array | None:
        """Return how sure the centres are (N,): what is cut is as far off as its middle in the image."""
        if detections.centers_m is None:
            return None
        given = detections.center_sigmas_m
        sigmas_m = np.full(len(detections), np.nan) if given is None else given.astype(np.float64)
        sigmas_m = np.where(np.isfinite(sigmas_m), sigmas_m, POINT_SIGMA_M)
        if detections.camera is not None:
            m_per_px = detections.centers_m[:, 2] / detections.camera.focal_px.mean()
            off_m = self._sigmas_px(sides_px, is_cut) * m_per_px
            sigmas_m = np.where(is_cut, np.hypot(sigmas_m, off_m), sigmas_m)
        return _f4(np.where(np.isfinite(sigmas_m), sigmas_m, POINT_SIGMA_M))


def _descriptors(detections: ObjectDetections) -> Float32Array:
    """Return the descriptors (N, D); zeros where an object has none."""
    if detections.descriptors is None:
        return np.empty((len(detections), 0), np.float32)
    return np.nan_to_num(detections.descriptors, nan=0.0)


def _f4(values: FloatArray) -> Float32Array:
    return values.astype(np.float32)
