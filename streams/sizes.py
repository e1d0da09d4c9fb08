"""How much memory a message holds."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np

_OVERHEAD = 64  # bytes of a small object, roughly


def nbytes(value: object) -> int:
    """Return about how many bytes a message keeps alive: its arrays, and those of messages inside."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (bytes, memoryview)):
        return len(value)
    if isinstance(value, tuple):
        return sum(map(nbytes, value))
    if is_dataclass(value):
        return _OVERHEAD + sum(nbytes(getattr(value, f.name)) for f in fields(value))
    return 0
