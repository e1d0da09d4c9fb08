"""One topic of a recording as the messages of one port."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from itertools import groupby
from typing import Any, Literal

import numpy as np

from mapstream.operators.sources.extrinsics import Extrinsics
from mapstream.operators.sources.stamps import StampWatch
from mapstream.recordings.decoding import Decoder
from mapstream.recordings.recording import RawMessage
from mapstream.streams.errors import DecodeError, TransformError
from mapstream.streams.messages.sensors import (
    ImuBatch,
    LidarScan,
    Message,
    RecordRef,
    TransformBatch,
)


@dataclass(frozen=True, slots=True)
class Played:
    """A message that is due at a log time; `starts_epoch` if its clock jumped."""

    port: str
    message: Message
    log_ns: int
    starts_epoch: bool = False
    lags: Mapping[str, int] = field(default_factory=dict)  # of the ports in this epoch, read ahead


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a topic becomes a port."""

    port: str
    path: str
    offset_ns: int = 0  # added to all stamps
    stamp: Literal["header", "log"] = "header"
    frame: str = ""  # of the sensor, where it is not the recorded one
    batch_ns: int = 0  # IMU samples of this much log time make one message
    origin_ns: int = 0  # where batches begin
    stops_on_error: bool = False


class TopicReader:
    """Decodes one topic, corrects its stamps, gathers IMU samples into batches."""

    def __init__(
        self, reading: Reading, decoder: Decoder, watch: StampWatch, extrinsics: Extrinsics
    ) -> None:
        self.reading = reading
        self.watch = watch
        self.losses: Counter[str] = Counter()
        self._decoder = decoder
        self._extrinsics = extrinsics
        self._samples: list[RawMessage] = []  # of the batch that is growing
        self._batch_end_ns = 0
        self._first_error = ""

    @property
    def topic(self) -> str:
        return self._decoder.channel.topic

    @property
    def notices(self) -> Counter[str]:
        """What was odd so far, by name."""
        of_decoder = {f"{self.topic}: {text}": n for text, n in self._decoder.notices.items()}
        return self.watch.notices + Counter(of_decoder)

    def read(self, raw: RawMessage) -> list[Played]:
        """Take the next message of the topic, after `flush`; return it if it needs no others.

        Raises:
            DecodeError: If it cannot be decoded, and the reading stops on errors.
        """
        if self._decoder.message_type is not ImuBatch:
            return [p for m in self._decode([raw]) for p in self._played(m, raw)]
        if not self._samples:
            start_ns, batch_ns = self.reading.origin_ns, self.reading.batch_ns
            self._batch_end_ns = start_ns + ((raw.log_ns - start_ns) // batch_ns + 1) * batch_ns
        self._samples.append(raw)
        return []

    def flush(self, log_ns: int | None = None) -> list[Played]:
        """Return the batch that ends before a log time, or what is left of it at the end.

        Raises:
            DecodeError: As in `read`.
        """
        if not self._samples or (log_ns is not None and log_ns < self._batch_end_ns):
            return []
        raws, self._samples = self._samples, []
        return [p for batch in self._imu_batches(raws) for p in self._played(batch, raws[-1])]

    def restart(self) -> None:
        """Forget what came before: a new epoch begins."""
        self._samples = []
        self.watch.restart()

    def _decode(self, raws: list[RawMessage]) -> list[Message]:
        """Decode messages one by one; those that cannot be decoded are counted."""
        found = []
        for raw in raws:
            try:
                found.append(self._decoder(raw))
            except DecodeError as error:
                if self.reading.stops_on_error:
                    raise
                first = str(error).removeprefix(f"{self.topic}: ")
                self._first_error = self._first_error or first
                self.losses[
                    f"messages that cannot be decoded; the first is {self._first_error}"
                ] += 1
        return found

    def _imu_batches(self, raws: list[RawMessage]) -> list[Message]:
        if self._decoder.parse_many is not None:
            try:
                together = self._decoder.many(raws)
            except DecodeError:
                pass  # one by one, then
            else:
                return [self._in_order(together, raws)]
        batches = [message for message in self._decode(raws) if isinstance(message, ImuBatch)]
        return [
            self._in_order(_joined(list(same)), raws)
            for _, same in groupby(batches, key=lambda batch: batch.frame)
        ]

    def _in_order(self, batch: Message, raws: list[RawMessage]) -> ImuBatch:
        """Take log times where they are wanted, and sort samples whose stamps run backwards."""
        if not isinstance(batch, ImuBatch):
            raise TypeError(f"expected an ImuBatch, got {type(batch).__name__}")
        if self.reading.stamp == "log" and len(raws) == len(batch.stamps_ns):
            batch = replace(batch, stamps_ns=np.array([raw.log_ns for raw in raws], np.int64))
        steps = np.diff(batch.stamps_ns)
        for _ in range(int((steps == 0).sum())):
            self.watch.note("stamps repeat", raws[0].log_ns)
        if not (steps < 0).any():
            return batch
        for _ in range(int((steps < 0).sum())):
            self.watch.note("stamps run backwards", raws[0].log_ns)
        order = np.argsort(batch.stamps_ns, kind="stable")
        return replace(
            batch,
            stamps_ns=batch.stamps_ns[order],
            gyro_radps=batch.gyro_radps[order],
            accel_mps2=batch.accel_mps2[order],
            is_saturated=None if batch.is_saturated is None else batch.is_saturated[order],
        )

    def _played(self, message: Message, raw: RawMessage) -> list[Played]:
        """Complete a message; none is left of one whose sensor's place is not known at its time."""
        reading, names = self.reading, _names(type(message))
        shift_ns = self._shift_ns(message, raw)
        changes: dict[str, Any] = {}
        if shift_ns and isinstance(message, (ImuBatch, TransformBatch)):
            changes["stamps_ns"] = message.stamps_ns + shift_ns
        elif shift_ns and "stamp_ns" in names:
            changes["stamp_ns"] = message.stamp_ns + shift_ns
        if "record" in names:
            changes["record"] = RecordRef(path=reading.path, topic=raw.topic, log_ns=raw.log_ns)
        if reading.frame and "frame" in names:
            changes["frame"] = reading.frame
        if "T_base_sensor" in names:
            frame = reading.frame or getattr(message, "frame", "")
            try:
                place = self._extrinsics.place(frame, message.stamp_ns + shift_ns)
            except TransformError as error:
                self.losses[f"messages without a place: {str(error).rsplit(':', 1)[0]}"] += 1
                return []
            if place is not None:
                changes["T_base_sensor"] = place
        if changes:
            message = replace(message, **changes)  # type: ignore[type-var]  # a dataclass by its names
        if isinstance(message, LidarScan) and _is_of_one_time(message):
            self.watch.note("scans whose points all have one time, not deskewed", raw.log_ns)
        jumped = self.watch.see(message.stamp_ns, raw.log_ns)
        return [Played(reading.port, message, raw.log_ns, jumped)]

    def _shift_ns(self, message: Message, raw: RawMessage) -> int:
        """Return what has to be added to the stamps."""
        reading = self.reading
        if message.stamp_ns > 0 and reading.stamp == "header":
            return reading.offset_ns
        if reading.stamp == "header":
            self.watch.note("stamps of zero, the log time is used", raw.log_ns)
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


def _joined(batches: list[ImuBatch]) -> ImuBatch:
    """Put batches of one frame behind each other."""
    if len(batches) == 1:
        return batches[0]
    flags = [
        np.zeros(len(b.stamps_ns), np.bool_) if b.is_saturated is None else b.is_saturated
        for b in batches
    ]
    return replace(
        batches[0],
        stamps_ns=np.concatenate([b.stamps_ns for b in batches]),
        gyro_radps=np.concatenate([b.gyro_radps for b in batches]),
        accel_mps2=np.concatenate([b.accel_mps2 for b in batches]),
        is_saturated=None
        if all(b.is_saturated is None for b in batches)
        else np.concatenate(flags),
    )
