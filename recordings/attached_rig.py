"""The sensor file inside a recording: places, noise and calibrations travel with what was measured."""

from __future__ import annotations

from pathlib import Path

from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import Recording, open_recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.rig import Rig
from mapstream.streams.rig_file import format_rig, load_rig, parse_rig

ATTACHMENT = "sensors.yaml"
_SUFFIXES = (".yaml", ".yml")


def attach_rig(writer: McapWriter, rig: Rig) -> None:
    """Put a sensor file into a recording.

    Raises:
        RecordingError: If the disk is full.
    """
    writer.attach(ATTACHMENT, format_rig(rig), media_type="application/yaml")


def attached_rig(recording: Recording) -> Rig | None:
    """Return what a recording says of its sensors; None where it says nothing.

    Raises:
        ConfigError: If the attached file is wrong.
        RecordingError: If it is damaged.
    """
    if not isinstance(recording, McapRecording):
        return None
    if all(attachment.name != ATTACHMENT for attachment in recording.attachments):
        return None
    place = recording.path / ATTACHMENT
    return parse_rig(recording.attachment(ATTACHMENT), place)


def rig_of(path: Path) -> Rig:
    """Read a sensor file, or the one that is attached to a recording.

    Raises:
        ConfigError: If the file is wrong, or the recording has none.
        RecordingError: If the recording cannot be read.
    """
    if path.suffix.lower() in _SUFFIXES:
        return load_rig(path)
    with open_recording(path) as recording:
        rig = attached_rig(recording)
    if rig is None:
        raise ConfigError(f"{path}: no {ATTACHMENT} is attached; give a sensor file of its own")
    return rig
