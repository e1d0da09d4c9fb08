"""128-bit ids, derived from content: the same data gives the same map, byte for byte."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.columns import IdArray

NUM_BYTES = 16


def derived_id(*parts: bytes | str | int) -> bytes:
    """Return 16 bytes that depend on every part and on where one part ends and the next begins."""
    digest = blake2b(digest_size=NUM_BYTES)
    for part in parts:
        if isinstance(part, int):
            part = part.to_bytes(8, "little", signed=True)  # noqa: PLW2901  # one part, as bytes
        elif isinstance(part, str):
            part = part.encode()  # noqa: PLW2901
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.digest()


def mission_id(recording: str, epoch: int = 0) -> str:
    """Return the 32 hex digits that name the mission of one epoch of a recording."""
    return derived_id("mission", recording, epoch).hex()


def vertex_id(mission: bytes, stamp_ns: int) -> bytes:
    """Return the id of the vertex of a mission, by its 16 bytes, at a stamp."""
    return derived_id("vertex", mission, stamp_ns)


def id_array(ids: Iterable[bytes]) -> IdArray:
    """Return ids as the rows of an array (N, 16)."""
    return np.frombuffer(b"".join(ids), dtype=np.uint8).reshape(-1, NUM_BYTES)


def as_keys(ids: IdArray) -> npt.NDArray[np.void]:
    """View ids (N, 16) as N values that can be sorted and compared."""
    return np.ascontiguousarray(ids).view(f"V{NUM_BYTES}")[:, 0]


def id_bytes(hex_digits: str) -> bytes:
    """Return the 16 bytes of 32 hex digits.

    Raises:
        ValueError: If the text is something else.
    """
    try:
        found = bytes.fromhex(hex_digits)
    except ValueError:
        found = b""
    if len(found) != NUM_BYTES:
        raise ValueError(f"an id has {2 * NUM_BYTES} hex digits, got {hex_digits!r}")
    return found
