"""An MCAP file that is there whole or not at all, for what can be made again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import RecordingError


@contextmanager
def whole_mcap(path: str | Path) -> Iterator[McapWriter]:
    """Write beside the path, and take the file's place only when all is written.

    Raises:
        RecordingError: If the disk refuses.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with McapWriter(part) as writer:
            yield writer
        part.replace(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    finally:
        part.unlink(missing_ok=True)
