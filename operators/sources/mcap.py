"""A recording as the source of a graph: MCAP, ROS 1 bag or rosbag2."""

from __future__ import annotations

from typing import Any

import anyio.to_thread

from mapstream.operators.operator import (
    Activity,
    DynamicPorts,
    NoPorts,
    Operator,
    Ports,
    context,
    offload,
)
from mapstream.operators.sources.cameras import Cameras
from mapstream.operators.sources.completion import Reading
from mapstream.operators.sources.extrinsics import Extrinsics
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.sources.playback import Playback
from mapstream.operators.sources.seeking import Seekable
from mapstream.operators.sources.stamps import StampWatch
from mapstream.operators.sources.topic_reader import Played, TopicReader
from mapstream.recordings.attached_rig import attached_rig
from mapstream.recordings.decoding import Decoder, decoder_for
from mapstream.recordings.recording import Recording, check_topics, open_recording
from mapstream.streams.errors import DecodeError
from mapstream.streams.rig import Rig
from mapstream.streams.rig_file import load_rig

_ADVANCE_NS = 10_000_000  # of log time between two updates of all bounds


class McapSource(DynamicPorts, Operator[NoPorts, Ports]):
    """Play a recording in log-time order, paced by the clock.

    Every message leaves with its stamp, its frame, and where it lies in the recording. Damaged parts
    and messages that cannot be decoded are counted as losses, odd stamps as warnings. A seek, or a
    sensor's clock that jumps, starts a new epoch.
    """

    placement = "thread"

    def __init__(self, config: McapSourceConfig) -> None:
        self.config = config
        self._readers: dict[str, TopicReader] = {}
        self._extrinsics: Extrinsics | None = None
        self._cameras: Cameras | None = None
        self._num_losses = 0
        self._advanced_ns: int | None = None

    @classmethod
    def ports_for(cls, config: McapSourceConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return {}, {port: config.message_type(port) for port in config.topics}

    async def run(self, inputs: NoPorts, outputs: Ports) -> None:  # noqa: ARG002
        config = self.config
        with await anyio.to_thread.run_sync(open_recording, config.path) as recording:
            start_ns = recording.start_ns + round(config.start_s * 1e9)
            end_ns = recording.end_ns + 1
            if config.end_s is not None:
                end_ns = min(end_ns, recording.start_ns + round(config.end_s * 1e9))
            context().activity.span_ns = (start_ns, end_ns)
            self._readers = await anyio.to_thread.run_sync(self._make_readers, recording)
            playback = Playback(recording, list(self._readers.values()), end_ns)
            playback.start(start_ns)
            try:
                await self._play(playback, recording, outputs)
            finally:
                playback.close()
                self._report(context().activity, recording)

    def _make_readers(self, recording: Recording) -> dict[str, TopicReader]:
        """Make a reader for each port.

        Raises:
            ConfigError: If the rig's file is wrong.
            RecordingError: If the recording lacks a topic.
            DecodeError: If a topic cannot be decoded, or not to the type of its port.
        """
        config = self.config
        wanted = {port: config.topic(port) for port in config.topics}
        given = [topic.calibration for topic in wanted.values() if topic.calibration]
        topics = [topic.topic for topic in wanted.values()]
        check_topics(config.path, topics + given, recording.topics)
        rig = load_rig(config.rig) if config.rig else attached_rig(recording)
        rig = rig or Rig(base_frame="base_link")
        base_frame = config.base_frame or rig.base_frame
        self._extrinsics = Extrinsics(recording, config.transforms, rig.transforms, base_frame)
        self._cameras = Cameras(recording, rig)
        return {
            port: TopicReader(
                self._reading(port, recording, rig),
                self._decoder(port, recording),
                StampWatch(topic.topic, max_jump_ns=round(config.max_jump_s * 1e9)),
                self._extrinsics,
                self._cameras,
            )
            for port, topic in wanted.items()
        }

    def _decoder(self, port: str, recording: Recording) -> Decoder:
        message_type = self.config.message_type(port)
        channel = recording.topics[self.config.topic(port).topic].channel
        try:
            return decoder_for(channel, None if message_type is Any else message_type)
        except DecodeError as error:
            text = f"{self.config.path}: port {port}: {error}{_hint(str(error))}"
            raise DecodeError(text) from error

    def _reading(self, port: str, recording: Recording, rig: Rig) -> Reading:
        config, topic = self.config, self.config.topic(port)
        sensor = rig.sensor_of_topic(topic.topic)
        return Reading(
            port=port,
            path=str(config.path),
            offset_ns=round(topic.offset_s * 1e9) + (sensor.time_offset_ns if sensor else 0),
            stamp=topic.stamp,
            frame=topic.frame or (rig.frame_of(sensor) if sensor else ""),
            calibration=topic.calibration,
            on_wrong_size=config.on_wrong_size,
            batch_ns=round(config.imu_batch_s * 1e9),
            origin_ns=recording.start_ns,
            stops_on_error=config.on_error == "stop",
        )

    async def _play(self, playback: Playback, recording: Recording, outputs: Ports) -> None:
        """Send batch after batch, from where a seek says if there is one."""
        clock, activity = context().clock, context().activity
        seekable = clock if isinstance(clock, Seekable) else None
        is_over = False
        while not is_over:
            batch = await offload(playback.next_batch)
            self._report(activity, recording)
            target_ns = None
            for played in batch:
                await clock.sleep_until(played.log_ns)
                target_ns = seekable.take_seek() if seekable else None
                if target_ns is not None:
                    break
                activity.position_ns = played.log_ns
                await self._send(played, outputs)
            is_over = not batch
            if is_over and seekable and seekable.section:  # a section that loops ends here
                await clock.sleep_until(seekable.section[1] + 1)
                target_ns = seekable.take_seek()
            if target_ns is not None:
                _start_epoch(outputs)
                playback.start(target_ns)
                is_over = False

    async def _send(self, played: Played, outputs: Ports) -> None:
        if played.starts_epoch:
            _start_epoch(outputs)
            self._advanced_ns = None
        await outputs[played.port].send(played.message)
        self._advance(played, outputs)

    def _advance(self, played: Played, outputs: Ports) -> None:
        """Promise on every port what its messages' lag so far and the configured lateness allow."""
        log_ns, lags = played.log_ns, played.lags
        if self._advanced_ns is not None and log_ns - self._advanced_ns < _ADVANCE_NS:
            return
        self._advanced_ns = log_ns
        lateness_ns = round(self.config.lateness_s * 1e9)
        for port, reader in self._readers.items():
            lag_ns = lags[port] if port in lags else min(lags.values())
            outputs[port].advance(log_ns + lag_ns - lateness_ns - reader.reading.batch_ns)

    def _report(self, activity: Activity, recording: Recording) -> None:
        """Bring the counts of warnings and losses up to date."""
        path = recording.path
        for loss in recording.losses[self._num_losses :]:
            topic = f"{loss.topic}: " if loss.topic else ""
            text = f"{path} at byte {loss.offset}: {topic}{loss.reason}"
            if loss.num_messages == 0:
                activity.warnings[text] = 1
            else:
                count = loss.num_messages or "an unknown number of"
                activity.losses[f"{text}; {count} messages lost"] = 1
        self._num_losses = len(recording.losses)
        for found in (self._extrinsics, self._cameras):
            activity.warnings.update(found.notices if found else {})
        for reader in self._readers.values():
            activity.warnings.update({f"{path}: {t}": n for t, n in reader.notices.items()})
            of_topic = f"{path}: {reader.topic}"
            activity.losses.update({f"{of_topic}: {t}": n for t, n in reader.losses.items()})


def _start_epoch(outputs: Ports) -> None:
    for sender in outputs.values():
        sender.start_epoch()


def _hint(error: str) -> str:
    if "EncodedImage" in error and "CameraFrame" in error:
        return "; read it as `images`, and add the operator image_decode"
    return ""
