"""One tuple per message of an anchor port, with what other ports have around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar, overload

from mapstream.streams.channel import Receiver
from mapstream.streams.extent import Extent, extent_of
from mapstream.streams.join import END, Join, Port
from mapstream.streams.messages.sensors import Message
from mapstream.streams.takes import Interpolate, Latest, Missing, Nearest, Reach, Take, Window

A = TypeVar("A", bound=Message)
M = TypeVar("M", bound=Message)
V = TypeVar("V")
R1 = TypeVar("R1")
R2 = TypeVar("R2")
R3 = TypeVar("R3")
_SECOND_NS = 1_000_000_000


class Anchored(Join[tuple[Any, ...]]):
    """See `anchored`."""

    def __init__(
        self,
        anchor: Receiver[Any],
        takes: tuple[Take[Any], ...],
        interval: Callable[[Any], tuple[int, int]],
    ) -> None:
        connected = [take.receiver for take in takes if take.receiver is not None]
        super().__init__([anchor, *connected])
        ports = iter(self.ports)
        self._anchor = next(ports)
        self._leading = [self._anchor]
        self._takes = [(take, None if take.receiver is None else next(ports)) for take in takes]
        self._interval = interval
        self._head: Any = None  # the anchor that `_extent` is of
        self._extent = Extent(0, 0)

    def _decide(self) -> tuple[Any, ...] | Port[Any] | None:
        anchor = self._anchor
        while anchor.next_ns < END:
            head = anchor.first
            if head is None:
                if not anchor.pull():
                    return anchor
                continue
            if head is not self._head:
                self._head, self._extent = head, Extent(*self._interval(head))
            found = self._find(head.stamp_ns)
            if isinstance(found, Port):
                return found
            anchor.forget_before(1)
            if found is not None:
                return (head, *found)
        return None

    def _find(self, stamp_ns: int) -> list[Any] | Port[Any] | None:
        """Return what the takes give; None if one that is needed has nothing."""
        results: list[Any] = []
        absent: list[str] = []
        for take, port in self._takes:
            if port is None:
                results.append(None)
                continue
            found = take.find(port, stamp_ns, self._extent)
            if isinstance(found, Port):
                return found
            if isinstance(found, Missing):
                if not take.is_optional:
                    self.stats.miss(self._anchor.name, found.reason, found.gap_ns)
                    return None
                absent.append(port.name)
                found = None
            results.append(found)
        self.stats.absent.update(absent)
        return results


@overload
def anchored(
    anchor: Receiver[A], take1: Take[R1], /, *, interval: Callable[[A], tuple[int, int]] = ...
) -> Join[tuple[A, R1]]: ...
@overload
def anchored(
    anchor: Receiver[A],
    take1: Take[R1],
    take2: Take[R2],
    /,
    *,
    interval: Callable[[A], tuple[int, int]] = ...,
) -> Join[tuple[A, R1, R2]]: ...
@overload
def anchored(
    anchor: Receiver[A],
    take1: Take[R1],
    take2: Take[R2],
    take3: Take[R3],
    /,
    *,
    interval: Callable[[A], tuple[int, int]] = ...,
) -> Join[tuple[A, R1, R2, R3]]: ...
@overload
def anchored(
    anchor: Receiver[Any], /, *takes: Take[Any], interval: Callable[[Any], tuple[int, int]] = ...
) -> Join[tuple[Any, ...]]: ...
def anchored(
    anchor: Receiver[Any],
    /,
    *takes: Take[Any],
    interval: Callable[[Any], tuple[int, int]] = extent_of,
) -> Join[Any]:
    """Join: one tuple (anchor, take 1, take 2, ...) per anchor message, in stamp order.

    An anchor for which a take has nothing is skipped and counted in `stats`, with the reason, unless
    that take is optional: then it gives None.

    Args:
        anchor: The port that sets the pace.
        takes: What to take from the others: `nearest`, `latest`, `window`, `interpolate`.
        interval: First and last instant of an anchor message [ns], for windows; by default those of
            its content, so that a window around a LiDAR scan reaches to the scan's last point.
    """
    return Anchored(anchor, takes, interval)


@overload
def nearest(receiver: Receiver[M], within_ns: int) -> Take[M]: ...
@overload
def nearest(
    receiver: Receiver[M] | None, within_ns: int, *, optional: Literal[True]
) -> Take[M | None]: ...
def nearest(
    receiver: Receiver[M] | None, within_ns: int, *, optional: bool = False
) -> Take[M] | Take[M | None]:
    """Take the message closest in time; of two equally close the earlier."""
    return Nearest(receiver, within_ns, optional=optional)


@overload
def latest(receiver: Receiver[M]) -> Take[M]: ...
@overload
def latest(receiver: Receiver[M] | None, *, optional: Literal[True]) -> Take[M | None]: ...
def latest(receiver: Receiver[M] | None, *, optional: bool = False) -> Take[M] | Take[M | None]:
    """Take the last message at or before the anchor."""
    return Latest(receiver, optional=optional)


@overload
def interpolate(
    receiver: Receiver[M], within_ns: int, function: Callable[[M, M, int], V]
) -> Take[V]: ...
@overload
def interpolate(
    receiver: Receiver[M] | None,
    within_ns: int,
    function: Callable[[M, M, int], V],
    *,
    optional: Literal[True],
) -> Take[V | None]: ...
def interpolate(
    receiver: Receiver[M] | None,
    within_ns: int,
    function: Callable[[M, M, int], V],
    *,
    optional: bool = False,
) -> Take[V] | Take[V | None]:
    """Take `function(before, after, stamp_ns)` of the two neighbours, each at most `within_ns` away.

    A message at the very stamp of the anchor is both.
    """
    return Interpolate(receiver, within_ns, function, optional=optional)


@overload
def window(
    receiver: Receiver[M],
    before_ns: int = ...,
    after_ns: int = ...,
    *,
    cover: bool = ...,
    patience_ns: int | None = ...,
    cut: Callable[[M, int, int], M] | None = ...,
) -> Take[tuple[M, ...]]: ...
@overload
def window(
    receiver: Receiver[M] | None,
    before_ns: int = ...,
    after_ns: int = ...,
    *,
    cover: bool = ...,
    patience_ns: int | None = ...,
    cut: Callable[[M, int, int], M] | None = ...,
    optional: Literal[True],
) -> Take[tuple[M, ...] | None]: ...
def window(  # noqa: PLR0913  # all but two by keyword
    receiver: Receiver[M] | None,
    before_ns: int = 0,
    after_ns: int = 0,
    *,
    cover: bool = True,
    patience_ns: int | None = None,
    cut: Callable[[M, int, int], M] | None = None,
    optional: bool = False,
) -> Take[tuple[M, ...]] | Take[tuple[M, ...] | None]:
    """Take all messages that overlap the anchor's interval, widened on both sides.

    Args:
        receiver: The port; None if it is optional and unconnected.
        before_ns: How far the window begins before the anchor's interval.
        after_ns: How far it ends after it.
        cover: The messages must enclose the window: the last one that starts in time and the first
            one that reaches its end are part of it, and without them there is no match.
        patience_ns: How far past the window's end, by stamps, to look for messages that reach back
            into it, and how long a gap at its ends may be. Default: 1 s with `cover`, else 0, which
            is right for messages of an instant; batches need their duration.
        cut: Called with each message and the window's ends, for instance `cut_imu`.
        optional: Give None instead of skipping the anchor.
    """
    reach = Reach(
        before_ns=before_ns,
        after_ns=after_ns,
        cover=cover,
        patience_ns=(_SECOND_NS if cover else 0) if patience_ns is None else patience_ns,
        cut=cut,
    )
    return Window(receiver, reach, optional=optional)
