"""How a run went, moment by moment, in a file: one JSON document per line and snapshot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from mapstream.graph.metrics import Snapshot


class TraceFile:
    """Writes snapshots; a context manager, to be given to `run_graph` as `on_progress`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __call__(self, snapshot: Snapshot) -> None:
        json.dump(snapshot.to_json(), self._file, allow_nan=False)
        self._file.write("\n")
