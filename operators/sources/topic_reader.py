"""One topic of a recording as the messages of one port."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from mapstream.operators.sources.cameras import Cameras
from mapstream.operators.sources.completion import Completion, Reading
from mapstream.operators.sources.extrinsics import Extrinsics
from mapstream.operators.sources.stamps import StampWatch
from mapstream.recordings.decoding import Decoder
from mapstream.recordings.recording import RawMessage
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.sensors import (
    ImuBatch,
    Message,
)


@dataclass(frozen=True, slots=True)
class Played:
    """A message that is due at a log time; `starts_epoch` if its clock jumped."""

    port: str
    message: Message
    log_ns: int
    starts_epoch: bool = False
    lags: Mapping[str, int] = field(default_factory=dict)  # of the ports in this epoch, read ahead


class TopicReader:
    """Decodes one topic, corrects its stamps, gathers IMU samples into batches."""

    def __init__(
        self,
        reading: Reading,
        decoder: Decoder,
        watch: StampWatch,
        extrinsics: Extrinsics,
        cameras: Cameras,
    ) -> None:
        self.reading = reading
        self.watch = watch
        self._decoder = decoder
        self._complete = Completion(reading, watch, extrinsics, cameras)
        self._undecoded: Counter[str] = Counter()
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

    @property
    def losses(self) -> Counter[str]:
        """What of the topic is gone, by name."""
        return self._undecoded + self._complete.losses

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
                self._undecoded[
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
        """Complete a message; none is left of one that has to go."""
        whole = self._complete(message, raw)
        if whole is None:
            return []
        jumped = self.watch.see(whole.stamp_ns, raw.log_ns)
        return [Played(self.reading.port, whole, raw.log_ns, jumped)]


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
