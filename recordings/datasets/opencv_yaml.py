"""YAML as OpenCV writes it, whose first line is none."""

from __future__ import annotations

from pathlib import Path

from mapstream.streams.errors import RecordingError
from mapstream.streams.fields import Fields


def read_opencv_yaml(path: Path) -> Fields:
    """Read a file that may begin with `%YAML:1.0`.

    Raises:
        RecordingError: If it cannot be read.
        ConfigError: If it is no YAML; the message has its line.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    return Fields.of_bytes(b"#" + content if content.startswith(b"%YAML:") else content, path)
