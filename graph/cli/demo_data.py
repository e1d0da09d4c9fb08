"""What the demos run on: a simulated drive, or a real one that is installed and converted once."""

from __future__ import annotations

import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mapstream.graph.cli.output import fraction_bar
from mapstream.graph.cli.simulate import write_world
from mapstream.recordings.cache import cache_folder
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.worlds.catalogue import WORLDS
from mapstream.streams.errors import RecordingError

_LAYOUT = 1  # of what a conversion writes; a new number makes old files in the cache void


def simulated(world: str, options: dict[str, Any], out: Path, seed: int) -> Path:
    """Write a synthetic recording."""
    write_world(world, out, WORLDS[world].config_type.model_validate(options), seed=seed)
    return out


def converted(kind: str, package: str) -> Path:
    """Return an installed data set as a recording: from the user's cache, or converted into it.

    A file in the cache is whole: it takes its place in one step, whoever else converts at the same time.

    Args:
        kind: As `mapstream convert` knows it, with data that is installed.
        package: The distribution that holds the data; another version is another file.

    Raises:
        RecordingError: If the data cannot be read, or the cache not be written.
    """
    folder = cache_folder()
    file = folder / f"{kind}-{version(package)}-{_LAYOUT}.mcap"
    if file.is_file():
        return file
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="converting-", dir=folder) as work:
            made = Path(work) / file.name
            with fraction_bar("converting") as show:
                convert(kind, made, on_progress=show)
            made.replace(file)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error}; set XDG_CACHE_HOME") from error
    return file
