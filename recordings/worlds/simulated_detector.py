"""A simulated object detector: it knows what each pixel shows, and errs as networks do.

What is seen of a thing is what the renderer drew of it, so that things hide each other. The errors depend on the seed
and on the image's number, not on who comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveInt

from mapstream.recordings.worlds.surfaces import Surface
from mapstream.recordings.worlds.things import Thing
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections, window

_SEED = 11  # apart from all that takes chance from the seed alone
_LEAST_SCORE = 0.05
_LESS = 0.25  # than the score of a thing, that of a false detection or the second of one thing
_FALSE_SIZES = (0.05, 0.3)  # of false detections, as parts of the image's width
_LEAST_PX = 2.0  # a side of a box


class SimulatedDetectorConfig(BaseModel):
    """What a detector gets wrong."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    score: float = Field(default=0.85, ge=_LEAST_SCORE, le=1.0)
    """Mean; those of false and of second detections are lower by a quarter."""
    score_sigma: NonNegativeFloat = 0.08
    missed: float = Field(default=0.05, ge=0.0, le=1.0)
    """Share of the things in view."""
    wrong_class: float = Field(default=0.02, ge=0.0, le=1.0)
    """Share of the detections."""
    duplicates: float = Field(default=0.02, ge=0.0, le=1.0)
    """Share of the things that are detected twice."""
    false_per_image: NonNegativeFloat = 0.05
    """Mean number of detections of what is not there."""
    box_noise_px: NonNegativeFloat = 1.5
    """Standard deviation of each edge."""
    masks: bool = True
    mask_noise_px: NonNegativeFloat = 1.0
    """Standard deviation of how far a mask reaches beyond its thing, or falls short of it."""
    min_pixels: PositiveInt = 80
    """What shows less is not detected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """One detection, and what it is of."""

    thing: Thing | None
    label: str
    score: float
    box_px: FloatArray  # (4,)
    mask: BoolArray  # (H, W)


class Detected(NamedTuple):
    """What a detector says, and the truth of it.

    The truth has a row for each detection, and then one for each thing that was missed: its box, mask, class and name
    (`texts`), and its centre, orientation and extent in the camera's frame. The row of a false detection has no class.
    """

    detections: ObjectDetections
    truth: ObjectDetections


class SimulatedDetector:
    """One detector behind one camera."""

    def __init__(
        self,
        config: SimulatedDetectorConfig,
        surfaces: Sequence[Surface],
        things: Sequence[Thing],
        frame: str,
        T_base_camera: SE3,
        seed: int,
    ) -> None:
        """Set up a detector of things, the last of which may be seen as surface -2, -3 ..."""
        self._config, self._seed, self._frame = config, seed, frame
        self._T_base_camera = T_base_camera
        self._labels = tuple(sorted({thing.label for thing in things}))
        rows = {thing.name: row for row, thing in enumerate(things)}
        of_surfaces = [rows.get(surface.name, -1) for surface in surfaces]
        beyond = [row for name, row in rows.items() if row not in of_surfaces]
        # Read from its end, it answers for the surfaces -1 (nothing), -2, -3 ...
        self._thing_of = np.array([*of_surfaces, *beyond[::-1], -1])

    def detect(
        self,
        surfaces: IntArray,
        things: Sequence[Thing],
        T_world_camera: FloatArray,
        number: int,
        stamp_ns: int,
    ) -> Detected:
        """Return what is detected in an image with a number.

        Args:
            surfaces: Which one each pixel (H, W) shows, as in a `Rendering`.
            things: Those of the start, where they are now.
            T_world_camera: Shape (4, 4).
            number: Of the image.
            stamp_ns: Of the image.
        """
        rng, config = np.random.default_rng((self._seed, _SEED, number)), self._config
        found, missed = [], []
        owner = self._thing_of[surfaces]
        pixels = np.bincount(owner.ravel() + 1, minlength=len(things) + 1)[1:]
        for row in np.flatnonzero(pixels >= config.min_pixels).tolist():
            seen = self._seen(things[row], owner == row)
            if rng.random() < config.missed:
                missed.append(seen)
                continue
            found.append(seen)
            if rng.random() < config.duplicates:
                found.append(replace(seen, score=seen.score - _LESS))
        found += [
            self._imagined(owner.shape, rng) for _ in range(rng.poisson(config.false_per_image))
        ]
        erred = [self._erred(each, rng) for each in found]
        order = np.argsort([-each.score for each in erred], kind="stable")
        ranked = [erred[row] for row in order]
        true = [found[row] for row in order] + missed
        if not config.masks:
            ranked = [replace(each, mask=np.zeros((0, 0), np.bool_)) for each in ranked]
        image = self._blank(owner.shape, stamp_ns)
        truth = [replace(each, score=float(each.thing is not None)) for each in true]
        return Detected(
            _message(image, ranked), _with_places(_message(image, truth), truth, T_world_camera)
        )

    def _blank(self, shape: tuple[int, ...], stamp_ns: int) -> ObjectDetections:
        return ObjectDetections(
            stamp_ns=stamp_ns,
            frame=self._frame,
            width_px=shape[1],
            height_px=shape[0],
            boxes_px=np.zeros((0, 4), np.float32),
            labels=(),
            scores=np.zeros(0, np.float32),
            T_base_sensor=self._T_base_camera,
        )

    def _seen(self, thing: Thing, mask: BoolArray) -> _Found:
        """Return what an ideal detector says of what is seen of a thing."""
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        box = np.array([columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5])
        return _Found(
            thing=thing, label=thing.label, score=self._config.score, box_px=box, mask=mask
        )

    def _imagined(self, shape: tuple[int, int], rng: np.random.Generator) -> _Found:
        """Return a detection of nothing, an ellipse somewhere in the image."""
        height, width = shape
        half = rng.uniform(*_FALSE_SIZES, 2) * width / 2
        middle = rng.uniform(0, [width, height])
        mask = np.zeros((height, width), np.uint8)
        cv2.ellipse(mask, (middle.tolist(), (2 * half).tolist(), 0.0), 1, cv2.FILLED)
        box = np.concatenate([middle - half, middle + half])
        label = str(rng.choice(self._labels)) if self._labels else ""
        score = self._config.score - _LESS
        return _Found(thing=None, label=label, score=score, box_px=box, mask=mask.astype(np.bool_))

    def _erred(self, found: _Found, rng: np.random.Generator) -> _Found:
        """Return a detection as the detector says it."""
        config = self._config
        height, width = found.mask.shape
        box = found.box_px + rng.normal(0.0, config.box_noise_px, 4)
        low = np.clip(box[:2], -0.5, [width - 0.5 - _LEAST_PX, height - 0.5 - _LEAST_PX])
        high = np.clip(box[2:], low + _LEAST_PX, [width - 0.5, height - 0.5])
        label, others = found.label, [each for each in self._labels if each != found.label]
        if rng.random() < config.wrong_class and others:
            label = str(rng.choice(others))
        score = np.clip(rng.normal(found.score, config.score_sigma), _LEAST_SCORE, 1.0)
        mask = _grown(found.mask, round(rng.normal(0.0, config.mask_noise_px)))
        return replace(
            found, label=label, score=float(score), box_px=np.concatenate([low, high]), mask=mask
        )


def _grown(mask: BoolArray, reach_px: int) -> BoolArray:
    """Return a mask that reaches farther than it did; less far where that is negative."""
    if reach_px == 0:
        return mask
    size = 2 * abs(reach_px) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    change = cv2.dilate if reach_px > 0 else cv2.erode
    return change(mask.astype(np.uint8), disc).astype(np.bool_)


def _message(image: ObjectDetections, found: Sequence[_Found]) -> ObjectDetections:
    """Return detections in an image that has none yet."""
    boxes = np.array([each.box_px for each in found], np.float32).reshape(-1, 4)
    windows = [window(box, image.width_px, image.height_px) for box in boxes]
    masks = tuple(
        np.ascontiguousarray(each.mask[pixels])
        for each, pixels in zip(found, windows, strict=True)
        if each.mask.size
    )
    return replace(
        image,
        boxes_px=boxes,
        labels=tuple(each.label for each in found),
        scores=np.array([each.score for each in found], np.float32),
        masks=masks,
        mask_sources=("model",) * len(masks),
    )


def _with_places(
    image: ObjectDetections, found: Sequence[_Found], T_world_camera: FloatArray
) -> ObjectDetections:
    """Return the truth with names and places; a false detection has neither."""
    T_camera_world = SE3(T_world_camera).inverse()
    rows = np.full((len(found), 10), np.nan)  # centre, orientation, extent
    for row, each in enumerate(found):
        if each.thing is not None:
            place = T_camera_world @ each.thing.T_world_box
            rows[row] = [*place.t, *place.quat_xyzw, *each.thing.extent_m]
    return replace(
        image,
        labels=tuple(each.thing.label if each.thing else "" for each in found),
        texts=tuple(each.thing.name if each.thing else "" for each in found),
        centers_m=rows[:, :3],
        quats_camera_object_xyzw=rows[:, 3:7],
        extents_m=rows[:, 7:],
    )
