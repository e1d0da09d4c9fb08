"""The tracks that a Lucas-Kanade tracker follows, and what is known of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.features.rows import appended, rows_of
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.messages.vision import ImageFeatures

_ADOPTION_PX = 2.0  # a detection so close to a track is of the same point


@dataclass(frozen=True, slots=True)
class LiveTracks:
    """Keypoints of the newest image that have numbers."""

    features: ImageFeatures
    ages: IntArray  # (N,) images in which each was seen before
    right_shifts_px: Float32Array  # (N, 2) from the left image to the right one; NaN: unknown

    @classmethod
    def new(cls, features: ImageFeatures) -> LiveTracks:
        count = len(features)
        return cls(features, np.zeros(count, np.int64), np.full((count, 2), np.nan, np.float32))

    def kept(self, rows: npt.NDArray[Any]) -> LiveTracks:
        """Return some of the tracks."""
        return LiveTracks(rows_of(self.features, rows), self.ages[rows], self.right_shifts_px[rows])

    def moved(self, px: Float32Array, now: ImageFeatures) -> LiveTracks:
        """Return the tracks in the next image, at their new places (N, 2); `now` tells of that image."""
        known = self.features
        points_m = None if known.points_m is None else np.full_like(known.points_m, np.nan)
        offsets_ns = None if known.offsets_ns is None else np.zeros_like(known.offsets_ns)
        features = replace(
            known,
            keypoints_px=px,
            points_m=points_m,  # what was measured elsewhere is not known here
            offsets_ns=offsets_ns,
            stamp_ns=now.stamp_ns,
            T_base_sensor=now.T_base_sensor,
            camera=now.camera,
            record=now.record,
        )
        return LiveTracks(features, self.ages + 1, self.right_shifts_px)

    def joined_by(self, features: ImageFeatures) -> LiveTracks:
        """Return the tracks and new ones."""
        new = LiveTracks.new(features)
        return LiveTracks(
            appended(self.features, features),
            np.concatenate([self.ages, new.ages]),
            np.concatenate([self.right_shifts_px, new.right_shifts_px]),
        )

    def refreshed_by(self, detections: ImageFeatures) -> LiveTracks:
        """Return the tracks with descriptors and the like of the detections at their places, where there are any."""
        from scipy.spatial import cKDTree  # noqa: PLC0415  # heavy, and most runs have no images

        features = self.features
        if len(features) == 0 or len(detections) == 0:
            return self
        distance_px, nearest = cKDTree(detections.keypoints_px).query(features.keypoints_px)
        at, of = np.flatnonzero(distance_px <= _ADOPTION_PX), nearest[distance_px <= _ADOPTION_PX]
        fresh: dict[str, Any] = {}
        for name in _TRAITS:
            old, new = getattr(features, name), getattr(detections, name)
            if old is not None and new is not None:
                fresh[name] = old.copy()
                fresh[name][at] = new[of]
        return replace(self, features=replace(features, **fresh))


_TRAITS = (
    "descriptors",
    "scores",
    "scales",
    "orientations_rad",
    "sigmas_px",
    "points_m",
    "point_sigmas_m",
    "offsets_ns",
)
