"""A source made from any async iterator of messages: whatever Python can say, a graph can read.

    async def poses():
        async for reading in my_robot:
            yield Odometry(stamp_ns=reading.time_ns, T_odom_base=SE3(reading.matrix))

    catalogue = Catalogue({"my_robot": iterator_source(poses, Odometry, port="odometry")})
    report = await run_graph(plan(load_graph("graph.yaml"), catalogue))

In the graph file it is an operator as any other: `sensors: {use: my_robot}`, `in: {odometry: sensors.odometry}`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import AsyncExitStack, aclosing
from typing import Any, TypeVar

from mapstream.operators.operator import (
    DynamicPorts,
    NoPorts,
    Operator,
    OperatorConfig,
    Ports,
    context,
)
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import Message

M = TypeVar("M", bound=Message)


class IteratorSourceConfig(OperatorConfig):
    """A source from an iterator has no options."""


def iterator_source(
    messages: Callable[[], AsyncIterator[M]], message_type: type[M], *, port: str = "messages"
) -> type[Operator[NoPorts, Ports]]:
    """Return an operator that sends what an async iterator yields.

    Messages go out when the clock reaches their stamps: at once with a clock on the wall, and in the order of
    all sources in a replay. The iterator is closed when the run ends.

    Args:
        messages: Called once per run; async generator functions fit. Stamps must increase.
        message_type: What it yields; the graph checks the wiring by it.
        port: The name of the output.
    """

    class IteratorSource(DynamicPorts, Operator[NoPorts, Ports]):
        """Send what an async iterator yields."""

        def __init__(self, config: IteratorSourceConfig) -> None:
            self._config = config

        @classmethod
        def ports_for(cls, config: IteratorSourceConfig) -> tuple[dict[str, Any], dict[str, Any]]:  # noqa: ARG003
            return {}, {port: message_type}

        async def run(self, inputs: NoPorts, outputs: Ports) -> None:  # noqa: ARG002
            clock, activity = context().clock, context().activity
            last_ns: int | None = None
            async with AsyncExitStack() as stack:
                iterator = messages()
                if isinstance(iterator, AsyncGenerator):
                    await stack.enter_async_context(aclosing(iterator))
                async for message in iterator:
                    _check(message, message_type, last_ns)
                    last_ns = message.stamp_ns
                    await clock.sleep_until(last_ns)
                    activity.position_ns = last_ns
                    await outputs[port].send(message)

    return IteratorSource


def _check(message: Message, expected: type[Message], last_ns: int | None) -> None:
    """Refuse what a graph could not use.

    Raises:
        OperatorError: If it is of another type, or not newer than the one before.
    """
    name = context().name
    if not isinstance(message, expected):
        found = type(message).__name__
        raise OperatorError(f"{name}: expected {expected.__name__} from the iterator, got {found}")
    if last_ns is not None and message.stamp_ns <= last_ns:
        stamps = f"{message.stamp_ns} after {last_ns} ns"
        raise OperatorError(f"{name}: stamps must increase, got {stamps}")
