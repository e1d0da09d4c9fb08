"""Where a channel with the policy `spool` keeps what it cannot hold: a file that nobody else sees."""

from __future__ import annotations

import pickle
import tempfile
from collections import deque
from pathlib import Path
from typing import IO

from mapstream.streams.limits import Entry


class DiskSpool:
    """Entries in a file without a name, first in, first out, bounded by bytes.

    There is a file only while there are entries, and it vanishes with the process, however that ends.
    Nobody else can write to it, so pickle is safe. Its space is free again once the last entry is read.
    """

    def __init__(self, max_bytes: int, directory: Path | None = None) -> None:
        """Make an empty spool.

        Args:
            max_bytes: How long the file may grow.
            directory: Where the file takes its space; by default where temporary files go.
        """
        self._max_bytes = max_bytes
        self._directory = directory
        self._file: IO[bytes] | None = None
        self._lengths: deque[tuple[int, ...]] = deque()  # of the parts of each entry
        self._read_at = 0
        self._write_at = 0

    def __len__(self) -> int:
        return len(self._lengths)

    def put(self, entry: Entry, *, even_if_full: bool = False) -> bool:
        """Keep one entry; False if the file would grow too long.

        Raises:
            OSError: If no file can be made, or the disk is full.
        """
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(entry, protocol=5, buffer_callback=buffers.append)
        parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
        length = sum(map(len, parts))
        if self._write_at + length > self._max_bytes and not even_if_full:
            return False
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._directory)  # noqa: SIM115  # see `clear`
        self._file.seek(self._write_at)
        for part in parts:
            self._file.write(part)
        self._write_at += length
        self._lengths.append(tuple(map(len, parts)))
        return True

    def get(self) -> Entry:
        """Return the oldest entry and forget it; its arrays are read-only, as they were.

        Raises:
            IndexError: If there is none.
        """
        if self._file is None:
            raise IndexError("the spool is empty")
        lengths = self._lengths.popleft()
        self._file.seek(self._read_at)
        head, *buffers = [self._file.read(length) for length in lengths]
        entry: Entry = pickle.loads(head, buffers=buffers)  # noqa: S301  # written above
        self._read_at += sum(lengths)
        if not self._lengths:
            self.clear()
        return entry

    def clear(self) -> None:
        """Forget all entries and give their space back."""
        self._lengths.clear()
        self._read_at = self._write_at = 0
        if self._file is not None:
            self._file.close()
            self._file = None
