"""Plain CSV with a described header, as MCAP; `column_files.py` lists the columns."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from mapstream.recordings.column_files import ColumnFile
from mapstream.recordings.datasets.conversion import (
    Notices,
    Progress,
    Topical,
    imu_batches,
    write_in_order,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import ImuBatch


def convert_csv(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write what the header describes: `/imu`, `/gnss`, `/odometry`, `/position`."""
    file = ColumnFile(source)
    streams: dict[str, list[Topical]] = defaultdict(list)
    for topic, message in file.messages():
        streams[topic].append((topic, message))
    if not streams:
        raise RecordingError(
            f"{source}: expected rows of measurements below the header, found none"
        )
    for topic, messages in streams.items():
        samples = [message for _, message in messages if isinstance(message, ImuBatch)]
        if samples:
            columns = (
                np.concatenate([getattr(sample, name) for sample in samples])
                for name in ("stamps_ns", "gyro_radps", "accel_mps2")
            )
            streams[topic] = list(imu_batches(topic, *columns))
    ends = [m.stamp_ns for messages in streams.values() for _, m in (messages[0], messages[-1])]
    write_in_order(writer, streams.values(), (min(ends), max(ends)), on_progress)
    if not file.unknown:
        return ()
    return (f"columns that mean nothing here were left out: {', '.join(file.unknown)}",)
