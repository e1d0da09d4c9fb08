"""How much of what a keyframe saw is still seen: tracks of cameras in common."""

from __future__ import annotations

from collections.abc import Sequence

from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures

Tracks = frozenset[tuple[str, int]]
"""Tracks of all cameras: kind and number."""


def tracks_of(seen: Sequence[ImageFeatures]) -> Tracks:
    """Return the tracks of all features."""
    return frozenset(
        (features.kind, track)
        for features in seen
        if features.track_ids is not None
        for track in features.track_ids.tolist()
        if track != NO_TRACK
    )


class Overlap:
    """The share of the last keyframe's tracks that are still seen."""

    def __init__(self, least: float) -> None:
        """Require this share; 0: none."""
        self._least = least
        self._tracks: Tracks = frozenset()

    def is_lost(self, seen: Sequence[ImageFeatures]) -> bool:
        """Return whether too little is left; not where the keyframe had no tracks."""
        if not self._tracks or not self._least:
            return False
        common = len(self._tracks & tracks_of(seen))
        return common < self._least * len(self._tracks)

    def restart(self, seen: Sequence[ImageFeatures]) -> None:
        """Count from these features on."""
        self._tracks = tracks_of(seen) if self._least else frozenset()
