"""A folder that one process writes at a time, and whose files appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Self

from mapstream.streams.errors import MapError

LOCK = ".mapstream.lock"
TEMPORARY = ".part"  # suffix of what is not yet written whole


class FolderLock:
    """The right to write into a folder; held from `with` on, given back even by a killed process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file = -1

    def __enter__(self) -> Self:
        """Make the folder if need be, and take the lock.

        Raises:
            MapError: If another run holds it, or the folder cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise MapError(f"{self.folder}: cannot be used as a map folder: {error}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(self._file, 32).decode(errors="replace").strip() or "unknown"
            os.close(self._file)
            raise MapError(
                f"{self.folder}: another run writes into this map folder (process {holder});"
                " wait for its end, or choose another folder"
            ) from error
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, str(os.getpid()).encode(), 0)
        return self

    def __exit__(self, *error: object) -> None:
        os.close(
            self._file
        )  # gives the lock back; the file stays, or two runs could lock two files


def write_whole(path: Path, data: bytes | memoryview, *, is_durable: bool = True) -> None:
    """Write a file that is there with all its bytes or, after a failure, as it was before.

    Args:
        path: The file; one with this name is replaced.
        data: Its bytes.
        is_durable: Wait for the disk, so that the file also survives a loss of power.

    Raises:
        OSError: If the disk is full, and for all else that a disk does.
    """
    part = path.with_name(path.name + TEMPORARY)
    try:
        with part.open("wb") as file:
            file.write(data)
            if is_durable:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    if is_durable:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make sure that names in a folder survive a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
