"""How much of what a keyframe saw is still seen: tracks of cameras in common."""

from __future__ import annotations

from mapstream.streams.messages.vision import NO_TRACK, NFrame


def tracks_of(n_frame: NFrame | None) -> frozenset[tuple[str, int]]:
    """Return the tracks of an n-frame: kind and number, over all cameras."""
    return frozenset(
        (features.kind, track)
        for features in (() if n_frame is None else n_frame.features)
        if features.track_ids is not None
        for track in features.track_ids.tolist()
        if track != NO_TRACK
    )


class Overlap:
    """The share of the last keyframe's tracks that an n-frame still sees."""

    def __init__(self, least: float) -> None:
        """Require this share; 0: none."""
        self._least = least
        self._tracks: frozenset[tuple[str, int]] = frozenset()

    def is_lost(self, n_frame: NFrame | None) -> bool:
        """Return whether too little is left; not where the keyframe had no tracks."""
        if not self._tracks or not self._least:
            return False
        common = len(self._tracks & tracks_of(n_frame))
        return common < self._least * len(self._tracks)

    def restart(self, n_frame: NFrame | None) -> None:
        """Count from this n-frame on."""
        self._tracks = tracks_of(n_frame) if self._least else frozenset()
