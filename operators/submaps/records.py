"""Where the raw measurements behind a keyframe lie."""

from __future__ import annotations

from collections.abc import Sequence

from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import CameraFrame, RecordRef
from mapstream.streams.messages.vision import ImageFeatures


def records_of(
    cloud: PointCloud | None, features: Sequence[ImageFeatures], images: Sequence[CameraFrame] = ()
) -> tuple[RecordRef, ...]:
    """Return the recorded messages of what was seen, each once, though several detectors read it."""
    seen = [cloud, *features, *images]
    records = [each.record for each in seen if each is not None and each.record is not None]
    return tuple(dict.fromkeys(records))
