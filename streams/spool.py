"""Where a channel with the policy `spool` keeps what it cannot hold: a file that nobody else sees."""

from __future__ import annotations

import pickle
import tempfile
from collections import deque
from pathlib import Path

from mapstream.streams.limits import Entry


class DiskSpool:
    """Entries in a file without a name, first in, first out, bounded by bytes.

    The file vanishes with the process, however that ends. Nobody else can write to it, so pickle is
    safe. Its space is used again once it has been read to the end.
    """

    def __init__(self, max_bytes: int, directory: Path | None = None) -> None:
        """Make an empty spool.

        Args:
            max_bytes: How long the file may grow.
            directory: Where the file takes its space; by default where temporary files go.

        Raises:
            OSError: If no file can be made there.
        """
        self._max_bytes = max_bytes
        self._file = tempfile.TemporaryFile(dir=directory)  # noqa: SIM115  # the spool's own lifetime
        self._lengths: deque[int] = deque()
        self._read_at = 0
        self._write_at = 0

    def __len__(self) -> int:
        return len(self._lengths)

    def put(self, entry: Entry, *, even_if_full: bool = False) -> bool:
        """Keep one entry; False if the file would grow too long.

        Raises:
            OSError: If the disk is full.
        """
        record = pickle.dumps(entry, protocol=pickle.HIGHEST_PROTOCOL)
        if self._write_at + len(record) > self._max_bytes and not even_if_full:
            return False
        self._file.seek(self._write_at)
        self._file.write(record)
        self._write_at += len(record)
        self._lengths.append(len(record))
        return True

    def get(self) -> Entry:
        """Return the oldest entry and forget it.

        Raises:
            IndexError: If there is none.
        """
        length = self._lengths.popleft()
        self._file.seek(self._read_at)
        entry: Entry = pickle.loads(self._file.read(length))  # noqa: S301  # written above
        self._read_at += length
        if not self._lengths:
            self.clear()
        return entry

    def clear(self) -> None:
        """Forget all entries and give their space back."""
        self._lengths.clear()
        self._read_at = self._write_at = 0
        self._file.truncate(0)

    def close(self) -> None:
        """Give up the file."""
        self._lengths.clear()
        self._file.close()
