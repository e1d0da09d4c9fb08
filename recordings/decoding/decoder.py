"""A decoder: the messages of one channel as messages of ours, with errors that name their place."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError as ProtobufError

from mapstream.recordings.recording import Channel, RawMessage
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.sensors import Message

_DAMAGE = (struct.error, ValueError, TypeError, KeyError, OverflowError, ProtobufError)
Parse = Callable[[memoryview], Message]
ParseMany = Callable[[Sequence[memoryview]], Message]


@dataclass(slots=True)
class Decoder:
    """Decodes the messages of one channel. `notices` counts what was left out or not understood."""

    channel: Channel
    message_type: type[Any]
    parse: Parse
    parse_many: ParseMany | None = None  # many messages to one; only where that is faster
    notices: Counter[str] = field(default_factory=Counter)

    def __call__(self, raw: RawMessage) -> Message:
        """Decode one message.

        Raises:
            DecodeError: With topic, schema, log time and reason.
        """
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers are refused by name
                return self.parse(raw.data)
        except _DAMAGE as error:
            raise self._error(raw, error) from error

    def many(self, raws: Sequence[RawMessage]) -> Message:
        """Decode messages into one, where `parse_many` is given.

        Raises:
            DecodeError: If one of them cannot be decoded; then decode them one by one.
        """
        if self.parse_many is None:
            raise TypeError(f"{self.channel.schema_name} has no way to be decoded in batches")
        try:
            return self.parse_many([raw.data for raw in raws])
        except _DAMAGE as error:
            raise self._error(raws[0], error) from error

    def _error(self, raw: RawMessage, error: Exception) -> DecodeError:
        return DecodeError(
            f"{raw.topic}: {self.channel.schema_name} at log time {raw.log_ns} "
            f"({len(raw.data)} bytes): {error}"
        )
