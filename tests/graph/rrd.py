"""What a Rerun file holds, for tests."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import RrdReader


def read_rrd(path: Path) -> dict[str, list[Any]]:
    """Return the record batches of each entity."""
    entities: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        entities.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return entities


def columns_of(batches: list[Any]) -> set[str]:
    return {name for batch in batches for name in batch.schema.names}


def values_of(batches: list[Any], column: str) -> list[Any]:
    """Return a column's rows, in the order in which they were drawn; chunks have an order of their own."""
    rows = []
    for batch in (batch for batch in batches if column in batch.schema.names):
        is_timed = "seq" in batch.schema.names
        order = batch.column("seq").to_pylist() if is_timed else [-1] * batch.num_rows
        rows += list(zip(order, batch.column(column).to_pylist(), strict=True))
    return [row for _, row in sorted(rows, key=lambda timed: timed[0]) if row is not None]


@contextmanager
def strict() -> Iterator[None]:
    """Make Rerun raise: by default it swallows its errors."""
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(False)


def unused_url() -> str:
    """Return a url of this machine at which nothing listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"rerun+http://127.0.0.1:{listener.getsockname()[1]}/proxy"
