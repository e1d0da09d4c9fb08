"""What a recorded message does not say itself: its corrected stamp, its frame, place, camera and record."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Literal

from mapstream.operators.images.calibrated import WrongSize, fitted, is_black
from mapstream.operators.sources.cameras import Cameras
from mapstream.operators.sources.extrinsics import Extrinsics
from mapstream.operators.sources.stamps import StampWatch
from mapstream.recordings.recording import RawMessage
from mapstream.streams.errors import TransformError
from mapstream.streams.messages.sensors import (
    CameraFrame,
    ImuBatch,
    LidarScan,
    Message,
    RecordRef,
    TransformBatch,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a topic becomes a port."""

    port: str
    path: str
    offset_ns: int = 0  # added to all stamps
    stamp: Literal["header", "log"] = "header"
    frame: str = ""  # of the sensor, where it is not the recorded one
    calibration: str | None = None  # the topic that describes the camera, if the config says so
    on_wrong_size: WrongSize = "drop"
    batch_ns: int = 0  # IMU samples of this much log time make one message
    origin_ns: int = 0  # where batches begin
    stops_on_error: bool = False


class Completion:
    """Completes the messages of one topic; counts what was odd or lost on the way."""

    def __init__(
        self, reading: Reading, watch: StampWatch, extrinsics: Extrinsics, cameras: Cameras
    ) -> None:
        self.losses: Counter[str] = Counter()
        self._reading = reading
        self._watch = watch
        self._extrinsics = extrinsics
        self._cameras = cameras

    def __call__(self, message: Message, raw: RawMessage) -> Message | None:
        """Return the whole message; None if it has to go, which is counted.

        A message goes if its sensor's place is not known at its time, an image also if its calibration is of
        another size.
        """
        names = _names(type(message))
        shift_ns = self._shift_ns(message, raw)
        frame = self._reading.frame or getattr(message, "frame", "")
        changes: dict[str, Any] = {}
        if shift_ns and isinstance(message, (ImuBatch, TransformBatch)):
            changes["stamps_ns"] = message.stamps_ns + shift_ns
        elif shift_ns and "stamp_ns" in names:
            changes["stamp_ns"] = message.stamp_ns + shift_ns
        if "record" in names:
            changes["record"] = RecordRef(
                path=self._reading.path, topic=raw.topic, log_ns=raw.log_ns
            )
        if self._reading.frame and "frame" in names:
            changes["frame"] = frame
        if "camera" in names:
            changes |= self._camera(message, raw.topic, frame)
        if "T_base_sensor" in names:
            try:
                place = self._extrinsics.place(frame, message.stamp_ns + shift_ns)
            except TransformError as error:
                self.losses[f"messages without a place: {str(error).rsplit(':', 1)[0]}"] += 1
                return None
            changes |= {} if place is None else {"T_base_sensor": place}
        if changes:
            message = replace(message, **changes)  # type: ignore[type-var]  # a dataclass by its names
        return self._looked_at(message, raw.log_ns)

    def _camera(self, message: Message, topic: str, frame: str) -> dict[str, Any]:
        """Return the calibration if there is one to add; what the message says itself comes first."""
        given = self._reading.calibration
        if given is None and getattr(message, "camera", None) is not None:
            return {}
        found = self._cameras.first(given) if given else self._cameras.calibration(topic, frame)
        return {} if found is None else {"camera": found}

    def _looked_at(self, message: Message, log_ns: int) -> Message | None:
        """Note scans without times, and images that are black or not of their calibration's size."""
        if isinstance(message, LidarScan) and _is_of_one_time(message):
            self._watch.note("scans whose points all have one time, not deskewed", log_ns)
        if not isinstance(message, CameraFrame):
            return message
        if is_black(message):
            self._watch.note("images that are black", log_ns)
        frame = fitted(message, self._reading.on_wrong_size)
        if isinstance(frame, str):
            self.losses[frame] += 1
            return None
        return frame

    def _shift_ns(self, message: Message, raw: RawMessage) -> int:
        """Return what has to be added to the stamps."""
        reading = self._reading
        if message.stamp_ns > 0 and reading.stamp == "header":
            return reading.offset_ns
        if reading.stamp == "header":
            self._watch.note("stamps of zero, the log time is used", raw.log_ns)
        return reading.offset_ns + raw.log_ns - message.stamp_ns


def _is_of_one_time(scan: LidarScan) -> bool:
    """Return whether points carry times that say nothing."""
    offsets_ns = scan.offsets_ns
    return (
        offsets_ns is not None and len(offsets_ns) > 1 and bool((offsets_ns == offsets_ns[0]).all())
    )


@cache
def _names(cls: type) -> frozenset[str]:
    return frozenset(field.name for field in fields(cls))
