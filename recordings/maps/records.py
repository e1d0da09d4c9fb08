"""The raw measurements that a map refers to, read from the recordings in which they lie."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.maps.model import Map
from mapstream.recordings.recording import open_recording
from mapstream.streams.arrays import IntArray
from mapstream.streams.messages.sensors import Message


def recorded(map_: Map, rows: IntArray) -> Iterator[tuple[int, Message]]:
    """Yield the messages behind resources of kind `record`, by recording and log time, with their rows.

    A message that is not in the recording any more is left out.

    Raises:
        RecordingError: If a recording is not there.
        DecodeError: If a message cannot be decoded.
    """
    resources = map_.resources
    for path in dict.fromkeys(resources.path[rows]):
        of_file = rows[resources.path[rows] == path]
        wanted = {
            (str(resources.topic[row]), int(resources.log_ns[row])): int(row) for row in of_file
        }
        log_ns = resources.log_ns[of_file]
        with open_recording(path) as recording:
            topics = sorted({topic for topic, _ in wanted} & recording.topics.keys())
            decoders = {t: decoder_for(recording.topics[t].channel) for t in topics}
            span = int(log_ns.min()), int(log_ns.max()) + 1
            for raw in recording.messages(topics, *span) if topics else ():
                row = wanted.get((raw.topic, raw.log_ns))
                if row is not None:
                    yield row, decoders[raw.topic](raw)


def record_rows(map_: Map, mission: int) -> IntArray:
    """Return the resources of a mission that lie in recordings."""
    resources = map_.resources
    of_mission = map_.vertices.mission[resources.vertex] == mission
    return np.flatnonzero(of_mission & (resources.kind == "record"))
