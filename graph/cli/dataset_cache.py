"""Data sets as recordings in the user's cache: converted once, and again when their files change."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

from mapstream.graph.cli.output import fraction_bar, say_aside
from mapstream.recordings.cache import cache_folder
from mapstream.recordings.datasets.catalogue import convert, source_of
from mapstream.streams.errors import RecordingError

_LAYOUT = 2  # of what a conversion writes; a new number makes old files in the cache void


def converted(spec: str) -> Path:
    """Return a data set as a recording: from the cache, or converted into it.

    A file in the cache is whole: it takes its place in one step, whoever else converts at the same time.

    Args:
        spec: As `mapstream convert` knows it: `euroc:DIR`, or a kind alone whose data is installed.

    Raises:
        ConfigError: If the kind is unknown, or there is nothing at the place.
        RecordingError: If the data cannot be read, or the cache not be written.
    """
    folder = cache_folder()
    kind = spec.partition(":")[0]
    source = source_of(spec)
    file = folder / f"{kind}-{source.stem}-{_fingerprint(source)}.mcap"
    if file.is_file():
        return file
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="converting-", dir=folder) as work:
            made = Path(work) / file.name
            with fraction_bar("converting") as show:
                done = convert(spec, made, on_progress=show)
            made.replace(file)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error}; set XDG_CACHE_HOME") from error
    for notice in done.notices:
        say_aside(f"{spec}: {notice}")
    return file


def _fingerprint(source: Path) -> str:
    """Return 12 hex digits that differ where a file was added, removed or written anew."""
    source = source.resolve()
    digest = hashlib.blake2b(f"{_LAYOUT} {source}".encode(), digest_size=6)
    for path in sorted(source.rglob("*")) if source.is_dir() else [source]:
        if path.is_file():
            status = path.stat()
            digest.update(f"{path}\0{status.st_size}\0{status.st_mtime_ns}\n".encode())
    return digest.hexdigest()
