"""A map as a folder: a manifest, and one content-addressed Arrow file per table (docs/map-format.md).

A file is named for the hash of its bytes, so that a save writes only tables that changed and never writes
over a file in use. Swapping the manifest is the one step that makes the new map the map.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from mapstream.recordings.maps.arrow import mapped, read_table, write_table
from mapstream.recordings.maps.columns import Table
from mapstream.recordings.maps.folder import TEMPORARY, FolderLock, write_whole
from mapstream.recordings.maps.manifest import (
    MANIFEST,
    TABLES_FOLDER,
    VERSION,
    Entries,
    Manifest,
    TableEntry,
    damaged,
    read_manifest,
    write_manifest,
)
from mapstream.recordings.maps.model import TABLES, Map, from_tables
from mapstream.streams.errors import MapError, MapFormatError

__all__ = [
    "CLOUDS",
    "MANIFEST",
    "TABLES_FOLDER",
    "VERSION",
    "load_map",
    "load_state",
    "read_manifest",
    "save_locked",
    "save_map",
]

CLOUDS = "clouds"  # where clouds of keyframes lie, see the resources
_MAX_MAP_BYTES = 2**36
_MAX_PAST = 20  # states that can be gone back to; each keeps the files of the tables that differ


def save_map(map_: Map, path: Path | str) -> None:
    """Save a map in a folder, in place of the map that may be there, which cannot be gone back to.

    Raises:
        MapError: If another run writes into the folder, or the disk refuses; the old map stays.
    """
    with FolderLock(Path(path)) as lock:
        save_locked(map_, lock)


def save_locked(map_: Map, lock: FolderLock, *, is_undoable: bool = False) -> None:
    """Save a map in the folder of a lock that the caller holds.

    Args:
        map_: The map.
        lock: Held on its folder.
        is_undoable: Keep the map that is there as a state that undo goes back to.

    Raises:
        MapError: If the disk refuses; the old map stays.
    """
    folder = lock.folder
    before = _files_in_use(folder)
    try:
        past = _past(read_manifest(folder)) if is_undoable else ()
        (folder / TABLES_FOLDER).mkdir(exist_ok=True)
        entries = {name: _save_table(folder, name, t) for name, t in map_.tables().items()}
        manifest = Manifest(tables=entries, past=past)
        write_manifest(folder, manifest)
    except OSError as error:
        _remove_all_but(folder, before)  # gives back what the attempt took
        raise MapError(
            f"{folder}: the map could not be saved: {error}; the map that was there is untouched"
        ) from error
    _remove_all_but(folder, manifest.files())


def _past(manifest: Manifest) -> tuple[Entries, ...]:
    return (*manifest.past, manifest.tables)[-_MAX_PAST:]


def _save_table(folder: Path, name: str, table: Table) -> TableEntry:
    data = write_table(table)
    sha256 = hashlib.sha256(data).hexdigest()
    file = f"{TABLES_FOLDER}/{name}-{sha256[:16]}.arrow"
    path = folder / file
    if not (path.exists() and path.read_bytes() == data):  # a damaged file is written again
        write_whole(path, data)
    return TableEntry(file=file, sha256=sha256, rows=len(table))


def _files_in_use(folder: Path) -> set[str]:
    """Return the tables' files of the map that is there; all of them where its manifest is unreadable."""
    try:
        return read_manifest(folder).files()
    except MapFormatError:
        return {f"{TABLES_FOLDER}/{path.name}" for path in (folder / TABLES_FOLDER).glob("*.arrow")}


def _remove_all_but(folder: Path, files: Iterable[str]) -> None:
    keep = {folder / file for file in files}
    for path in (folder / TABLES_FOLDER).glob("*"):
        if path.name.endswith((".arrow", TEMPORARY)) and path not in keep:
            with suppress(OSError):  # what stays does no harm, and the next save tries again
                path.unlink()


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
            return load_state(folder, {name: manifest.tables[name] for name in names}, max_bytes)
        except FileNotFoundError as error:
            newer = read_manifest(folder)
            if newer == manifest:
                raise damaged(folder, f"{error.filename} is missing") from error
            manifest = newer  # the map was saved anew while it was read


def load_state(folder: Path, state: Entries, max_bytes: int = _MAX_MAP_BYTES) -> Map:
    """Load one state of the map in a folder; tables that it does not name stay empty.

    Raises:
        FileNotFoundError: If a file is not there.
        MapFormatError: If a file is damaged, or all are too large.
    """
    num_bytes = sum((folder / entry.file).stat().st_size for entry in state.values())
    if num_bytes > max_bytes:
        limit = f"more than the limit of {max_bytes}; load some of its tables, or allow more"
        raise MapFormatError(f"{folder}: the tables have {num_bytes} bytes, {limit}")
    return from_tables({name: _load_table(folder, name, entry) for name, entry in state.items()})


def _load_table(folder: Path, name: str, entry: TableEntry) -> Table:
    file = folder / entry.file
    if not file.stat().st_size:
        raise damaged(file, "it is empty")
    source = mapped(file)
    if hashlib.sha256(source).hexdigest() != entry.sha256:
        raise damaged(file, "its bytes are not those that were saved (sha256 differs)")
    try:
        table = read_table(TABLES[name], source)
    except ValueError as error:
        raise damaged(file, str(error)) from error
    if len(table) != entry.rows:
        raise damaged(file, f"expected {entry.rows} rows, got {len(table)}")
    return table
