"""YAML as OpenCV writes it, whose first line is none, and as it reads it, with `key:value` in one word."""

from __future__ import annotations

import re
from pathlib import Path

from mapstream.streams.errors import RecordingError
from mapstream.streams.fields import Fields

_KEY = re.compile(rb"^(\s*[\w.]+:)(?=[^\s:])", re.MULTILINE)


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
    text = _KEY.sub(rb"\1 ", content)
    return Fields.of_bytes(b"#" + text if text.startswith(b"%YAML:") else text, path)
