"""Detectors and descriptors by name, each behind one call.

ORB: Rublee et al., ICCV 2011. BRISK: Leutenegger et al., ICCV 2011. FREAK: Alahi et al., CVPR 2012.
SIFT: Lowe, IJCV 2004. BRISK and FREAK describe ORB's keypoints, as maplab does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.features.spread import Spread, spread
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import Float32Array

DetectorKind = Literal["orb", "brisk", "freak", "sift"]
_PATCH_PX = 20  # whose moments give an ORB keypoint its orientation
_DESCRIBED_PX = 12.0  # what BRISK and FREAK are told of its size; their patterns reach farther
_EDGE_PX = {"orb": _PATCH_PX, "brisk": 20, "freak": 39}  # closer to the border nothing is described


class DetectorOptions(OperatorConfig):
    """Which keypoints an image gives; the numbers are maplab's."""

    max_features: PositiveInt = 700
    """So many are kept, the strongest; at most a quarter of them in one cell of a grid of 4 x 2."""
    min_distance_px: NonNegativeFloat = 8.0
    """Between any two."""
    max_candidates: PositiveInt = 2000
    """The strongest corners, of which those are chosen."""
    fast_threshold: PositiveInt = 20
    """Least contrast of a corner [grey values]; of orb, brisk and freak."""
    num_levels: PositiveInt = 1
    """Of the image pyramid, the image itself among them; of orb, brisk and freak."""
    scale_factor: float = Field(default=1.2, gt=1.0)
    """Between two levels; of orb, brisk and freak."""
    image_scale: float = Field(default=1.0, gt=0.1, le=1.0)
    """Of the image in which is searched; at 0.5 sift takes a third of the time."""
    sigma_px: PositiveFloat = 0.8
    """Uncertainty of a keypoint; of one found in a smaller image it is larger."""


@dataclass(frozen=True, slots=True)
class Detected:
    """What a detector found in an image, the strongest first."""

    px: Float32Array  # (N, 2)
    descriptors: npt.NDArray[Any]  # (N, D)
    scores: Float32Array  # (N,)
    scales: Float32Array  # (N,) diameter [px]
    orientations_rad: Float32Array  # (N,)
    sigmas_px: Float32Array  # (N,)


class Detector(Protocol):
    """Finds and describes keypoints; it is used by one thread at a time."""

    def detect(self, image: GrayImage) -> Detected:
        """Return the keypoints of an image (H, W)."""
        ...


def make_detector(kind: DetectorKind, options: DetectorOptions) -> Detector:
    """Return a detector by its name."""
    return Sift(options) if kind == "sift" else Corners(kind, options)


class Corners:
    """ORB's corners, described by ORB, BRISK or FREAK."""

    def __init__(self, kind: Literal["orb", "brisk", "freak"], options: DetectorOptions) -> None:
        self._options = options
        self._orb = cv2.ORB.create(
            nfeatures=options.max_candidates,
            scaleFactor=options.scale_factor,
            nlevels=options.num_levels,
            edgeThreshold=_EDGE_PX[kind],
            patchSize=_PATCH_PX,
            fastThreshold=options.fast_threshold,
        )
        self._describer: Any = self._orb
        if kind != "orb":  # BRISK takes 30 ms to make
            self._describer = getattr(cv2.xfeatures2d, kind.upper()).create()

    def detect(self, image: GrayImage) -> Detected:
        small = _Small.of(image, self._options.image_scale)
        keypoints = self._orb.detect(small.image)
        chosen = [keypoints[row] for row in _spread(small, keypoints, self._options)]
        if self._describer is not self._orb:
            for keypoint in chosen:
                keypoint.size *= _DESCRIBED_PX / _PATCH_PX
        described, descriptors = self._describer.compute(small.image, chosen)
        if descriptors is None:  # of no keypoint
            descriptors = np.empty((0, self._describer.descriptorSize()), np.uint8)
        levels = np.array([keypoint.octave for keypoint in described])
        sigmas_px = self._options.sigma_px * self._options.scale_factor**levels
        return _detected(small, described, descriptors, sigmas_px)


class Sift:
    """SIFT's keypoints and descriptors."""

    def __init__(self, options: DetectorOptions) -> None:
        self._options = options
        self._sift: Any = cv2.SIFT.create(options.max_candidates)

    def detect(self, image: GrayImage) -> Detected:
        small = _Small.of(image, self._options.image_scale)
        keypoints, descriptors = self._sift.detectAndCompute(small.image, None)
        rows = _spread(small, keypoints, self._options)
        if descriptors is None:  # of no keypoint
            descriptors = np.empty((0, self._sift.descriptorSize()), np.float32)
        sigmas_px = np.full(len(rows), self._options.sigma_px)
        return _detected(small, [keypoints[row] for row in rows], descriptors[rows], sigmas_px)


@dataclass(frozen=True, slots=True)
class _Small:
    """The image in which is searched, and its pixels per pixel of the image itself."""

    image: GrayImage
    size_px: tuple[int, int]  # of the image itself
    scale: npt.NDArray[np.float64]  # (2,)

    @classmethod
    def of(cls, image: GrayImage, scale: float) -> _Small:
        height, width = image.shape
        if scale == 1:
            return cls(image, (width, height), np.ones(2))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return cls(np.asarray(small, np.uint8), (width, height), np.array(size) / (width, height))

    def places(self, keypoints: Sequence[cv2.KeyPoint]) -> Float32Array:
        """Return where keypoints of the small image are in the image itself, (N, 2)."""
        px = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2)
        return ((px + 0.5) / self.scale - 0.5).astype(np.float32)


def _spread(
    small: _Small, keypoints: Sequence[cv2.KeyPoint], options: DetectorOptions
) -> list[int]:
    """Return which keypoints to keep, the strongest first."""
    scores = np.array([keypoint.response for keypoint in keypoints], np.float32)
    wanted = Spread(limit=options.max_features, min_distance_px=options.min_distance_px)
    rows: list[int] = spread(small.places(keypoints), scores, small.size_px, wanted).tolist()
    return rows


def _detected(
    small: _Small,
    keypoints: Sequence[cv2.KeyPoint],
    descriptors: npt.NDArray[Any],
    sigmas_px: npt.NDArray[np.floating],
) -> Detected:
    scale = small.scale.mean()
    angles = np.array([keypoint.angle for keypoint in keypoints])
    return Detected(
        px=small.places(keypoints),
        descriptors=descriptors,
        scores=np.array([keypoint.response for keypoint in keypoints], np.float32),
        scales=np.array([keypoint.size / scale for keypoint in keypoints], np.float32),
        orientations_rad=np.radians(angles).astype(np.float32),
        sigmas_px=(sigmas_px / scale).astype(np.float32),
    )
