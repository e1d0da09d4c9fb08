"""Moving messages in time: what a sensor's clock offset does to its stamps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

from mapstream.streams.messages.sensors import ImuBatch, Message, TransformBatch

M = TypeVar("M", bound=Message)


def shifted(message: M, offset_ns: int) -> M:
    """Return a sensor's message with the offset added to its stamps; times within it stay as they are."""
    if offset_ns == 0:
        return message
    changed: Any = message  # every message of a sensor is a dataclass
    if isinstance(message, (ImuBatch, TransformBatch)):
        return replace(changed, stamps_ns=message.stamps_ns + offset_ns)  # type: ignore[no-any-return]
    return replace(changed, stamp_ns=message.stamp_ns + offset_ns)  # type: ignore[no-any-return]
