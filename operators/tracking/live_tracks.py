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

    def unlike(self, detections: ImageFeatures) -> str | None:
        """Return why detections cannot become tracks beside these, None if they can."""
        ours, theirs = self.features, detections
        if len(ours) == 0 or len(theirs) == 0:
            return None
        if ours.kind != theirs.kind:
            return (
                f"keypoints of kind {theirs.kind} where tracks are of kind {ours.kind}; "
                "give each kind an operator of its own"
            )
        if ours.descriptors.shape[1] != theirs.descriptors.shape[1]:
            widths = f"{ours.descriptors.shape[1]} to {theirs.descriptors.shape[1]}"
            return f"descriptors of kind {theirs.kind} changed their length from {widths}"
        return None

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
