"""A map as a folder: a manifest, and one content-addressed Arrow file per table (docs/map-format.md).

A file is named for the hash of its bytes, so that a save writes only tables that changed and never writes
over a file in use. Swapping the manifest is the one step that makes the new map the map.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from mapstream.recordings.maps.arrow import mapped, read_table, write_table
from mapstream.recordings.maps.folder import TEMPORARY, FolderLock, write_whole
from mapstream.recordings.maps.model import TABLES, Map, from_tables
from mapstream.recordings.maps.tables import Table
from mapstream.streams.errors import MapError, MapFormatError

IDENTIFIER = "mapstream map"
VERSION = 2
MANIFEST = "manifest.json"
TABLES_FOLDER = "tables"
CLOUDS = "clouds"  # where clouds of keyframes lie, see the resources
_FILE = re.compile(r"tables/[a-z]+-[0-9a-f]{16}\.arrow")
_MAX_MANIFEST_BYTES = 1_000_000
_MAX_MAP_BYTES = 2**36


class TableEntry(BaseModel):
    """Where a table lies and what its file must hold."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    file: str
    sha256: str
    rows: NonNegativeInt


class Manifest(BaseModel):
    """What `manifest.json` says."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    identifier: str = IDENTIFIER
    version: int = VERSION
    tables: dict[str, TableEntry]


def save_map(map_: Map, path: Path | str) -> None:
    """Save a map in a folder, in place of the map that may be there.

    Raises:
        MapError: If another run writes into the folder, or the disk refuses; the old map stays.
    """
    with FolderLock(Path(path)) as lock:
        save_locked(map_, lock)


def save_locked(map_: Map, lock: FolderLock) -> None:
    """Save a map in the folder of a lock that the caller holds.

    Raises:
        MapError: If the disk refuses; the old map stays.
    """
    folder = lock.folder
    before = _files_in_use(folder)
    try:
        (folder / TABLES_FOLDER).mkdir(exist_ok=True)
        entries = {name: _save_table(folder, name, t) for name, t in map_.tables().items()}
        manifest = json.dumps(Manifest(tables=entries).model_dump(), indent=1) + "\n"
        write_whole(folder / MANIFEST, manifest.encode())
    except OSError as error:
        _remove_all_but(folder, before)  # gives back what the attempt took
        raise MapError(
            f"{folder}: the map could not be saved: {error}; the map that was there is untouched"
        ) from error
    _remove_all_but(folder, [entry.file for entry in entries.values()])


def _save_table(folder: Path, name: str, table: Table) -> TableEntry:
    data = write_table(table)
    sha256 = hashlib.sha256(data).hexdigest()
    file = f"{TABLES_FOLDER}/{name}-{sha256[:16]}.arrow"
    path = folder / file
    if not (path.exists() and path.read_bytes() == data):  # a damaged file is written again
        write_whole(path, data)
    return TableEntry(file=file, sha256=sha256, rows=len(table))


def _files_in_use(folder: Path) -> list[str]:
    """Return the tables' files of the map that is there; all of them where its manifest is unreadable."""
    try:
        return [entry.file for entry in read_manifest(folder).tables.values()]
    except MapFormatError:
        return [f"{TABLES_FOLDER}/{path.name}" for path in (folder / TABLES_FOLDER).glob("*.arrow")]


def _remove_all_but(folder: Path, files: Iterable[str]) -> None:
    keep = {folder / file for file in files}
    for path in (folder / TABLES_FOLDER).glob("*"):
        if path.name.endswith((".arrow", TEMPORARY)) and path not in keep:
            with suppress(OSError):  # what stays does no harm, and the next save tries again
                path.unlink()


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
        raise _damaged(file, str(error)) from error
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
        raise _damaged(file, str(error)) from error
    if set(manifest.tables) != set(TABLES):
        raise _damaged(file, f"expected the tables {sorted(TABLES)}, got {sorted(manifest.tables)}")
    for entry in manifest.tables.values():
        if not _FILE.fullmatch(entry.file):
            raise _damaged(file, f"{entry.file!r} is not the name of a table's file")
    return manifest


def load_map(
    path: Path | str, *, tables: Iterable[str] | None = None, max_bytes: int = _MAX_MAP_BYTES
) -> Map:
    """Load a map; numeric columns are views of the mapped files and take memory as they are read.

    Args:
        path: The map's folder.
        tables: Names of the tables to load, the others stay empty; all by default.
        max_bytes: Refuse maps whose tables are larger.

    Raises:
        MapFormatError: If there is no map, it is of another version, damaged or too large.
        ValueError: If no table has such a name.
    """
    folder = Path(path)
    names = list(TABLES) if tables is None else list(tables)
    if unknown := set(names) - set(TABLES):
        raise ValueError(f"no tables {sorted(unknown)}; a map has {sorted(TABLES)}")
    manifest = read_manifest(folder)
    while True:
        try:
            num_bytes = sum((folder / manifest.tables[name].file).stat().st_size for name in names)
            if num_bytes > max_bytes:
                limit = (
                    f"more than the limit of {max_bytes}; load some of its tables, or allow more"
                )
                raise MapFormatError(f"{folder}: the tables have {num_bytes} bytes, {limit}")
            return from_tables({n: _load_table(folder, n, manifest.tables[n]) for n in names})
        except FileNotFoundError as error:
            newer = read_manifest(folder)
            if newer == manifest:
                raise _damaged(folder, f"{error.filename} is missing") from error
            manifest = newer  # the map was saved anew while it was read


def _load_table(folder: Path, name: str, entry: TableEntry) -> Table:
    file = folder / entry.file
    if not file.stat().st_size:
        raise _damaged(file, "it is empty")
    source = mapped(file)
    if hashlib.sha256(source).hexdigest() != entry.sha256:
        raise _damaged(file, "its bytes are not those that were saved (sha256 differs)")
    try:
        table = read_table(TABLES[name], source)
    except ValueError as error:
        raise _damaged(file, str(error)) from error
    if len(table) != entry.rows:
        raise _damaged(file, f"expected {entry.rows} rows, got {len(table)}")
    return table


def _damaged(file: Path, reason: str) -> MapFormatError:
    return MapFormatError(f"{file}: damaged: {reason}; restore the map folder from a copy")
