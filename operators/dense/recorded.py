"""Recorded measurements of a map's vertices as sources send them: with calibration, place and stamp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.images.frame_filter import DEPTHS
from mapstream.operators.sources.cameras import Cameras
from mapstream.operators.sources.completion import Completion, Reading
from mapstream.operators.sources.extrinsics import Extrinsics
from mapstream.operators.sources.stamps import StampWatch
from mapstream.recordings.attached_rig import attached_rig
from mapstream.recordings.decoding import Decoder, decoder_for
from mapstream.recordings.maps.cameras import Camera, cameras_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.recording import Recording, open_recording
from mapstream.streams.arrays import IntArray
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage, Message
from mapstream.streams.rig import Rig

_TRANSFORMS = ("/tf", "/tf_static")
_DECODE = ImageDecode(ImageDecodeConfig())
_DEPTHS = {"mono16": "16UC1"}  # what a file of 16 bits holds


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One measurement of a vertex."""

    vertex: int
    message: Message  # images are decoded; those of 16 bits or floats are depth


def recorded_at(map_: Map, rows: IntArray) -> Iterator[Recorded]:
    """Yield what resources of kind `record` refer to, by recording and log time.

    The map's own calibration of a camera counts; where it has none, that of the recording's sensor file or topics.
    A message that is not in the recording any more, or that cannot be read, is left out.

    Raises:
        RecordingError: If a recording is not there.
        DecodeError: If a message cannot be decoded.
    """
    resources = map_.resources
    cameras = [cameras_of(map_, mission) for mission in range(len(map_.missions))]
    for path in dict.fromkeys(resources.path[rows]):
        of_file = rows[resources.path[rows] == path]
        vertices: dict[tuple[str, int], list[int]] = {}
        for row in of_file.tolist():
            at = str(resources.topic[row]), int(resources.log_ns[row])
            vertices.setdefault(at, []).append(int(resources.vertex[row]))
        with open_recording(path) as recording:
            topics = sorted({topic for topic, _ in vertices} & recording.topics.keys())
            readers = _readers(recording, topics)
            log_ns = resources.log_ns[of_file]
            span = int(log_ns.min()), int(log_ns.max()) + 1
            for raw in recording.messages(topics, *span) if topics else ():
                wanted = vertices.get((raw.topic, raw.log_ns), ())
                decode, complete = readers[raw.topic]
                message = complete(decode(raw), raw) if wanted else None
                message = None if message is None else _decoded(message)
                for vertex in wanted:
                    known = cameras[int(map_.vertices.mission[vertex])]
                    if message is not None:
                        yield Recorded(vertex, _calibrated(message, known))


def record_rows_of(map_: Map, kinds: tuple[type, ...], vertices: IntArray) -> IntArray:
    """Return the records of some vertices, of topics whose first such record is of one of these types.

    An image of depth and one of colour are of the types `DepthImage` and `CameraFrame`.

    Raises:
        RecordingError: If a recording is not there.
        DecodeError: If a message cannot be decoded.
    """
    resources = map_.resources
    is_asked = (resources.kind == "record") & np.isin(resources.vertex, vertices)
    rows = np.flatnonzero(is_asked)
    sources = [*zip(resources.path[rows].tolist(), resources.topic[rows].tolist(), strict=True)]
    kept: dict[tuple[str, str], bool] = {}
    for row, source in zip(rows.tolist(), sources, strict=True):
        if source not in kept:
            first = next(recorded_at(map_, np.array([row])), None)
            kept[source] = first is not None and kind_of(first.message) in kinds
    return rows[[kept[source] for source in sources]] if len(rows) else rows


class DepthImage:
    """The kind of camera frames whose pixels are depths."""


def kind_of(message: Message) -> type:
    """Return the type of a message, where images of depth are of a type of their own."""
    if isinstance(message, CameraFrame) and message.encoding in DEPTHS:
        return DepthImage
    return type(message)


def _readers(recording: Recording, topics: list[str]) -> dict[str, tuple[Decoder, Completion]]:
    """Return what decodes and what completes the messages of each topic."""
    rig = attached_rig(recording) or Rig(base_frame="base_link")
    extrinsics = Extrinsics(recording, _TRANSFORMS, rig.transforms, rig.base_frame)
    cameras = Cameras(recording, rig)
    readers = {}
    for topic in topics:
        sensor = rig.sensor_of_topic(topic)
        reading = Reading(
            port=topic,
            path=str(recording.path),
            offset_ns=sensor.time_offset_ns if sensor else 0,
            frame=rig.frame_of(sensor) if sensor else "",
        )
        watch = StampWatch(topic, max_jump_ns=2**62)
        complete = Completion(reading, watch, extrinsics, cameras)
        readers[topic] = decoder_for(recording.topics[topic].channel), complete
    return readers


def _decoded(message: Message) -> Message | None:
    """Return a message with its pixels decoded; None if they cannot be."""
    if not isinstance(message, EncodedImage | CameraFrame):
        return message
    decoded = _DECODE.decode(message)
    if not isinstance(decoded, CameraFrame):
        return None
    return replace(decoded, encoding=_DEPTHS.get(decoded.encoding, decoded.encoding))


def _calibrated(message: Message, cameras: Mapping[str, Camera]) -> Message:
    """Return an image as the map says that its camera sees, if it says anything."""
    known = cameras.get(message.frame) if isinstance(message, CameraFrame) else None
    if known is None:
        return message
    return replace(message, camera=known.calibration, T_base_sensor=known.T_base_sensor)  # type: ignore[type-var]  # an image
