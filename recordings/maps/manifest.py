"""The manifest of a map's folder: which files are the map now, and which were it before an operation.

What undo and redo need lies in the manifest itself, so that one rename swaps the map and its history alike.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import TABLES
from mapstream.streams.errors import MapFormatError

IDENTIFIER = "mapstream map"
VERSION = 4
MANIFEST = "manifest.json"
TABLES_FOLDER = "tables"
_FILE = re.compile(r"tables/[a-z_]+-[0-9a-f]{16}\.arrow")
_MAX_MANIFEST_BYTES = 1_000_000


class TableEntry(BaseModel):
    """Where a table lies and what its file must hold."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    file: str
    sha256: str
    rows: NonNegativeInt


Entries = dict[str, TableEntry]  # of the tables of one state of a map, by name


class Manifest(BaseModel):
    """What `manifest.json` says."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    identifier: str = IDENTIFIER
    version: int = VERSION
    tables: Entries
    past: tuple[Entries, ...] = ()  # states that undo goes back to, the newest last
    future: tuple[Entries, ...] = ()  # states that were undone, the next to redo last

    @property
    def states(self) -> tuple[Entries, ...]:
        """All states whose files belong to the folder: the present one, past and future ones."""
        return self.tables, *self.past, *self.future

    def files(self) -> set[str]:
        """Return the files of all states, relative to the folder."""
        return {entry.file for state in self.states for entry in state.values()}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Make what a manifest names the map of a folder, in one step.

    Raises:
        OSError: If the disk refuses; the old manifest stays.
    """
    write_whole(folder / MANIFEST, (json.dumps(manifest.model_dump(), indent=1) + "\n").encode())


def read_manifest(path: Path | str) -> Manifest:
    """Read and check the manifest of a map folder.

    Raises:
        MapFormatError: If there is none, it is damaged, or it is of another version.
    """
    file = Path(path) / MANIFEST
    try:
        with file.open("rb") as opened:
            text = opened.read(_MAX_MANIFEST_BYTES + 1)
    except OSError as error:
        reason = f"{path}: not a map folder: {error.strerror}: {MANIFEST}"
        raise MapFormatError(f"{reason}; give the folder that a run wrote its map into") from error
    try:
        content = json.loads(text[:_MAX_MANIFEST_BYTES])
        is_map = isinstance(content, dict) and content.get("identifier") == IDENTIFIER
    except ValueError as error:
        raise damaged(file, str(error)) from error
    if not is_map:
        raise MapFormatError(f"{file}: expected the identifier {IDENTIFIER!r}; not a map folder")
    if content.get("version") != VERSION:
        raise MapFormatError(
            f"{file}: format version {content.get('version')}, but this mapstream reads version"
            f" {VERSION}; use the mapstream that wrote the map, or a newer one"
        )
    try:
        manifest = Manifest.model_validate(content)
    except ValidationError as error:
        raise damaged(file, str(error)) from error
    for state in manifest.states:
        _require_entries(file, state)
    return manifest


def _require_entries(file: Path, state: Entries) -> None:
    if set(state) != set(TABLES):
        raise damaged(file, f"expected the tables {sorted(TABLES)}, got {sorted(state)}")
    for entry in state.values():
        if not _FILE.fullmatch(entry.file):
            raise damaged(file, f"{entry.file!r} is not the name of a table's file")


def damaged(file: Path, reason: str) -> MapFormatError:
    """Return the error that says that a file of a map is not what it was."""
    return MapFormatError(f"{file}: damaged: {reason}; restore the map folder from a copy")
