"""Changes to a map in its folder: each goes into the journal, and can be undone and done again.

The manifest names the tables of earlier states, whose files stay while it does (`manifest.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from mapstream.recordings.maps.check import require_valid
from mapstream.recordings.maps.combine import with_journal_entry
from mapstream.recordings.maps.folder import FolderLock
from mapstream.recordings.maps.manifest import Manifest, damaged, read_manifest, write_manifest
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import CLOUDS, load_map, load_state, save_locked
from mapstream.streams.errors import MapError, MapFormatError

ReportT = TypeVar("ReportT")


def change_map(
    path: Path | str,
    operation: str,
    tool: Callable[[Map], tuple[Map, ReportT]],
    /,
    **parameters: object,
) -> ReportT:
    """Let a tool change the map in a folder, note it in the map's journal, and return the tool's report.

    No other run can write into the folder meanwhile, and `undo` brings back the map that was there.

    Args:
        path: The map's folder.
        operation: The name of what is done.
        tool: Takes the map, returns the changed one and a report.
        parameters: With what it is done; JSON values, those that are None are left out.

    Raises:
        MapFormatError: If there is no map, or it is damaged.
        MapCheckError: If the map breaks the rules of maps, before or after; nothing is saved then.
        MapError: If another run writes into the folder, or the disk refuses.
    """
    folder = Path(path)
    read_manifest(folder)  # or the lock would make a folder where there is none
    with FolderLock(folder) as lock:
        changed, report = tool(require_valid(load_map(folder)))
        given = {name: value for name, value in parameters.items() if value is not None}
        changed = with_journal_entry(changed, operation, **given)
        save_locked(require_valid(changed), lock, is_undoable=True)
        _remove_loose_clouds(folder)
    return report


def undo(path: Path | str) -> Map:
    """Bring back the map as it was before the last change, and return it.

    Raises:
        MapError: If there is nothing to undo, another run writes into the folder, or the disk refuses.
        MapFormatError: If the earlier map is damaged; the present one stays.
    """

    def earlier(now: Manifest) -> Manifest:
        if not now.past:
            raise MapError(f"{path}: there is nothing to undo; what runs and imports write stays")
        return Manifest(tables=now.past[-1], past=now.past[:-1], future=(*now.future, now.tables))

    return _go(Path(path), earlier)


def redo(path: Path | str) -> Map:
    """Do again what was undone last, and return the map.

    Raises:
        MapError, MapFormatError: As `undo`.
    """

    def later(now: Manifest) -> Manifest:
        if not now.future:
            raise MapError(
                f"{path}: there is nothing to do again; a new change forgets what was undone"
            )
        return Manifest(tables=now.future[-1], past=(*now.past, now.tables), future=now.future[:-1])

    return _go(Path(path), later)


def _go(folder: Path, step: Callable[[Manifest], Manifest]) -> Map:
    read_manifest(folder)
    with FolderLock(folder):
        manifest = step(read_manifest(folder))
        try:
            map_ = load_state(folder, manifest.tables)  # whole, or the present map stays
            write_manifest(folder, manifest)
        except FileNotFoundError as error:
            raise damaged(folder, f"{error.filename} is missing") from error
        except OSError as error:
            raise MapError(f"{folder}: the map could not be changed: {error}") from error
    return map_


def _remove_loose_clouds(folder: Path) -> None:
    """Remove clouds that no state of the map names any more."""
    manifest = read_manifest(folder)
    tables = {state["resources"].file: state["resources"] for state in manifest.states}
    kept = set()
    try:
        for entry in tables.values():
            resources = load_state(folder, {"resources": entry}).resources
            kept |= {folder / path for path in resources.path[resources.topic == ""]}
    except (FileNotFoundError, MapFormatError):
        return  # an earlier state is damaged, and may have named any cloud
    for file in (folder / CLOUDS).glob("*"):
        if file not in kept:
            with suppress(OSError):  # what stays does no harm, and the next change tries again
                file.unlink()
