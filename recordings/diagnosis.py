"""What is in a recording and what is wrong with it: rates, gaps, clocks, units, axes, losses.

One pass over the file; messages are decoded where there is a decoder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapstream.recordings.decoding import Decoder, decoder_for
from mapstream.recordings.input_checks import InputChecks
from mapstream.recordings.recording import Loss, RawMessage, Recording, Topic
from mapstream.recordings.sensor_checks import CloudChecks, check_imu
from mapstream.recordings.stamp_checks import Finding, Times, check_offsets, check_times
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.sensors import ImuBatch, LidarScan

_BATCH = 256  # IMU messages that are decoded together
_PROGRESS = 1000  # messages between two calls of on_progress


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicHealth:
    """One topic as it really is."""

    topic: str
    schema_name: str
    message_type: type[Any] | None  # None: no decoder
    num_read: int
    num_undecodable: int
    rate_hz: float  # of log times; nan for fewer than three messages
    offset_s: float  # stamps ahead of log times, in the middle; nan without stamps


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """What `diagnose` found, worst of all the losses."""

    path: Path
    duration_s: float
    topics: tuple[TopicHealth, ...]
    findings: tuple[Finding, ...]
    losses: tuple[Loss, ...]

    @property
    def is_clean(self) -> bool:
        """True if nothing is lost and nothing is worth a warning."""
        return not self.losses and all(f.severity == "note" for f in self.findings)


def diagnose(recording: Recording, on_progress: Callable[[int], None] | None = None) -> Diagnosis:
    """Read a whole recording and tell what is wrong with it.

    Args:
        recording: It stays open.
        on_progress: Called now and then with the log time that was reached.

    Raises:
        RecordingError: If nothing of it can be read.
    """
    patients = {name: _Patient(topic) for name, topic in recording.topics.items()}
    for i, raw in enumerate(recording.messages()):
        patients[raw.topic].see(raw)
        if on_progress is not None and i % _PROGRESS == 0:
            on_progress(raw.log_ns)
    for patient in patients.values():
        patient.finish()
    findings: list[Finding] = []
    stamped = [patient.times for patient in patients.values() if patient.has_stamps]
    if not any(patient.health.num_read for patient in patients.values()):
        findings.append(Finding(name="no_messages", topic="", text="there is no message in it"))
    findings += [finding for patient in patients.values() for finding in patient.findings()]
    return Diagnosis(
        path=recording.path,
        duration_s=(recording.end_ns - recording.start_ns) / 1e9,
        topics=tuple(patient.health for patient in patients.values()),
        findings=tuple(findings + check_offsets(stamped)),
        losses=tuple(recording.losses),
    )


class _Patient:
    """One topic under examination."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._decoder: Decoder | None = None
        self._refusal = ""
        try:
            self._decoder = decoder_for(topic.channel)
        except DecodeError as error:
            self._refusal = str(error).removeprefix(f"{topic.name}: ")
        self._log_ns: list[int] = []
        self._stamped_log_ns: list[int] = []
        self._stamps_ns: list[int] = []
        self._waiting: list[RawMessage] = []
        self._accel: list[FloatArray] = []
        self._gyro: list[FloatArray] = []
        self._clouds = CloudChecks(topic.name)
        self._inputs = InputChecks(topic.name)
        self._errors: Counter[str] = Counter()

    def see(self, raw: RawMessage) -> None:
        """Take note of one message."""
        self._log_ns.append(raw.log_ns)
        if self._decoder is None:
            return
        self._waiting.append(raw)
        if self._decoder.parse_many is None or len(self._waiting) == _BATCH:
            self.finish()

    def finish(self) -> None:
        """Decode what is waiting."""
        raws, self._waiting = self._waiting, []
        if self._decoder is None or not raws:
            return
        if self._decoder.parse_many is not None:
            try:
                together = self._decoder.many(raws)
            except DecodeError:
                pass  # one by one, then
            else:
                self._take(together, raws)
                return
        for raw in raws:
            try:
                self._take(self._decoder(raw), [raw])
            except DecodeError as error:
                self._errors[str(error).removeprefix(f"{self._topic.name}: ")] += 1

    def _take(self, message: Any, raws: list[RawMessage]) -> None:  # noqa: ANN401
        if isinstance(message, ImuBatch):
            self._accel.append(message.accel_mps2)
            self._gyro.append(message.gyro_radps)
        elif isinstance(message, LidarScan):
            self._clouds.add(message)
        else:
            self._inputs.see(message)
        is_one_by_one = isinstance(message, ImuBatch) and len(message.stamps_ns) == len(raws)
        stamps_ns = message.stamps_ns.tolist() if is_one_by_one else [message.stamp_ns]
        self._stamps_ns += stamps_ns
        self._stamped_log_ns += [raw.log_ns for raw in raws[-len(stamps_ns) :]]

    @property
    def has_stamps(self) -> bool:
        return bool(self._stamps_ns) and not self._topic.name.endswith("tf_static")

    @property
    def times(self) -> Times:
        """Times of what was decoded, or log times alone."""
        log_ns = self._stamped_log_ns if self.has_stamps else self._log_ns
        stamps_ns = self._stamps_ns if self.has_stamps else self._log_ns
        return Times(
            topic=self._topic.name,
            log_ns=np.array(log_ns, np.int64),
            stamps_ns=np.array(stamps_ns, np.int64),
        )

    @property
    def health(self) -> TopicHealth:
        log_ns = np.array(self._log_ns, np.int64)
        span_s = (log_ns[-1] - log_ns[0]) / 1e9 if len(log_ns) > 2 else 0.0
        return TopicHealth(
            topic=self._topic.name,
            schema_name=self._topic.schema_name,
            message_type=self._decoder.message_type if self._decoder else None,
            num_read=len(log_ns),
            num_undecodable=sum(self._errors.values()),
            rate_hz=float((len(log_ns) - 1) / span_s) if span_s > 0 else float("nan"),
            offset_s=self.times.offset_ns / 1e9 if self.has_stamps else float("nan"),
        )

    def findings(self) -> list[Finding]:
        """Return what is odd about this topic alone."""
        name, times = self._topic.name, self.times
        found = [] if name.endswith("tf_static") else check_times(times)
        if self._refusal:
            found.append(
                Finding(name="no_decoder", topic=name, text=self._refusal, severity="note")
            )
        if self._errors:
            count, first = sum(self._errors.values()), next(iter(self._errors))
            text = f"{count} messages cannot be decoded; the first: {first}"
            found.append(Finding(name="undecodable", topic=name, text=text))
        if self._decoder is not None:
            found += [
                Finding(name="decoder_notice", topic=name, text=f"{count} {text}")
                for text, count in self._decoder.notices.items()
            ]
        if self._accel:
            found += check_imu(name, np.concatenate(self._accel), np.concatenate(self._gyro))
        if self._decoder is not None and self._decoder.message_type is LidarScan:
            found += self._clouds.findings(times.period_ns)
        return [*found, *self._inputs.findings()]
