"""What an operator is, and what the runtime gives it.

An operator reads messages from its inputs and sends messages to its outputs. `Inputs` and `Outputs` are
frozen dataclasses whose fields are `Receiver[M]` and `Sender[M]`; the graph and mypy check the wiring
from these annotations. A source has no inputs, a sink has no outputs (`NoPorts`).

`run` is the flow and holds no arithmetic; heavy calls go through `offload`, which runs them where the
graph file says. When the inputs end, `run` returns and the runtime closes the outputs. After a seek or
a jump of the clock the runtime makes a new operator and runs it, unless `spans_epochs` is set.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic_ns as _monotonic_ns
from time import thread_time_ns
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import anyio
import anyio.to_thread
from pydantic import BaseModel, BeforeValidator, ConfigDict

from mapstream.operators.durations import Durations
from mapstream.streams.channel import Receiver
from mapstream.streams.clock import Clock, WallClock
from mapstream.streams.messages.sensors import Message

InputsT = TypeVar("InputsT")
OutputsT = TypeVar("OutputsT")
M = TypeVar("M", bound=Message)
R = TypeVar("R")

Placement = Literal["inline", "thread", "process"]
# of a config; the empty text, with which a parameter of a graph says that there is none, is no path
OptionalPath = Annotated[Path | None, BeforeValidator(lambda given: None if given == "" else given)]


class OperatorConfig(BaseModel):
    """Options of an operator: frozen, unknown keys refused, defaults that work, units in the names."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True
    )


@dataclass(frozen=True)
class NoPorts:
    """The inputs of a source, the outputs of a sink."""


class Ports(dict[str, Any]):
    """Inputs or outputs whose names come from the config: `outputs["scans"]` is a Sender."""

    def __init__(self, **ports: Any) -> None:  # noqa: ANN401  # ends of channels of any message
        super().__init__(ports)


class DynamicPorts(ABC):
    """An operator whose ports its config names; its Inputs or Outputs are `Ports`."""

    @classmethod
    @abstractmethod
    def ports_for(cls, config: Any) -> tuple[dict[str, Any], dict[str, Any]]:  # noqa: ANN401  # of its own type
        """Return the message type of each input and of each output; `Any` where it is not known."""


@dataclass(slots=True)
class Activity:
    """What an operator did so far; the runtime reads it for plots, the progress bar and the report."""

    calls: Durations = field(default_factory=Durations)  # offloaded
    num_running: int = 0  # offloaded and not finished
    loop_ns: int = 0  # time on the event loop, inline calls included
    cpu_ns: int = 0  # processor time of the loop's and the calls' threads
    rss_bytes: int | None = None  # memory of the operator's own process, if it has one
    position_ns: int | None = None  # of a source: log time
    span_ns: tuple[int, int] | None = None  # of a source: first and last log time
    warnings: dict[str, int] = field(default_factory=dict)  # message -> how often
    losses: dict[str, int] = field(default_factory=dict)  # the same, of data that is gone
    written: list[str] = field(default_factory=list)  # files and folders, as the user named them


@dataclass(frozen=True, slots=True)
class Context:
    """What the runtime tells a running operator."""

    name: str = "operator"
    clock: Clock = field(default_factory=WallClock)
    placement: Placement = "inline"
    workers: int = 1
    limiter: anyio.CapacityLimiter | None = (
        None  # of the threads that this operator may use at a time
    )
    activity: Activity = field(default_factory=Activity)


_context: ContextVar[Context] = ContextVar("mapstream_operator")


def context() -> Context:
    """Return what the runtime told the operator that runs now."""
    found = _context.get(None)
    if found is None:
        found = Context()
        _context.set(found)
    return found


def set_context(value: Context) -> None:
    """Tell the tasks that start from here on which operator they are; for runtimes."""
    _context.set(value)


def warn(message: str) -> None:
    """Count something that the user should know, though the run goes on; shown in the report."""
    warnings = context().activity.warnings
    warnings[message] = warnings.get(message, 0) + 1


def report_loss(message: str) -> None:
    """Count data that was there and could not be used, a damaged chunk for instance.

    The run goes on, and ends as `lossy`.
    """
    losses = context().activity.losses
    losses[message] = losses.get(message, 0) + 1


def report_written(path: Path) -> None:
    """Tell the user of a file or a folder that is whole now; naming it again changes nothing."""
    written = context().activity.written
    if str(path) not in written:
        written.append(str(path))


async def offload(function: Callable[..., R], *args: object) -> R:
    """Call a function where the graph file placed this operator, and wait for its result.

    `inline` and `process` call it here (the whole operator lives in its process), `thread` in a thread.
    """
    ctx = context()
    activity = ctx.activity
    activity.num_running += 1
    started_ns = _monotonic_ns()
    try:
        if ctx.placement != "thread":
            return function(*args)
        call = _ThreadCall(function)
        try:
            return await anyio.to_thread.run_sync(call, *args, limiter=ctx.limiter)
        finally:
            activity.cpu_ns += call.cpu_ns
    finally:
        activity.num_running -= 1
        activity.calls.add(_monotonic_ns() - started_ns)


class _ThreadCall(Generic[R]):
    """A function that notes the processor time its thread spends in it."""

    def __init__(self, function: Callable[..., R]) -> None:
        self._function = function
        self.cpu_ns = 0

    def __call__(self, *args: object) -> R:
        started_ns = thread_time_ns()
        try:
            return self._function(*args)
        finally:
            self.cpu_ns = thread_time_ns() - started_ns


async def pipeline(
    function: Callable[[M], R], messages: Receiver[M], send: Callable[[R], Awaitable[None]]
) -> None:
    """Call a stateless function on each message, `workers` at a time, and send the results in order.

    A result is sent as soon as those before it are; so is an error raised.
    """
    ctx = context()
    if ctx.workers == 1 or ctx.placement != "thread":
        async for message in messages:
            await send(await offload(function, message))
        return

    async def work(message: M, turn: anyio.Event, next_turn: anyio.Event) -> None:
        try:
            result = await offload(function, message)
        except Exception:  # it is raised in the order of the messages, behind the results before it
            await turn.wait()
            raise
        await turn.wait()
        await send(result)
        next_turn.set()
        free.release()

    free = anyio.Semaphore(ctx.workers)
    turn = anyio.Event()
    turn.set()
    async with anyio.create_task_group() as tasks:
        async for message in messages:
            await free.acquire()
            next_turn = anyio.Event()
            tasks.start_soon(work, message, turn, next_turn)
            turn = next_turn


class Operator(ABC, Generic[InputsT, OutputsT]):
    """A stage of a graph. A subclass names its ports in the brackets and its config in `__init__`."""

    placement: ClassVar[Placement] = "inline"
    spans_epochs: ClassVar[bool] = False

    @abstractmethod
    async def run(self, inputs: InputsT, outputs: OutputsT) -> None:
        """Read inputs and send outputs until the inputs end."""
