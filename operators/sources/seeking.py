"""What a source asks a clock that can seek."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from mapstream.streams.clock import Clock


@runtime_checkable
class Seekable(Protocol):
    """A clock that can ask to play from somewhere else."""

    @property
    def section(self) -> tuple[int, int] | None: ...

    def take_seek(self) -> int | None: ...


def seek_target(clock: Clock) -> int | None:
    """Return where the clock wants to play from now, once; None: go on."""
    return clock.take_seek() if isinstance(clock, Seekable) else None
