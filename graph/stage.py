"""One operator of a run: from its making, through its epochs and its errors, to its end."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Coroutine, Generator, Mapping
from dataclasses import dataclass, field
from time import monotonic_ns
from typing import Any, Literal

import anyio

from mapstream.graph.plan import Node
from mapstream.graph.spec import OnErrorSpec
from mapstream.operators.operator import Activity, Context, Operator, Ports, set_context
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import MappingError, OperatorError

_log = logging.getLogger(__name__)

State = Literal["waiting", "running", "ended", "failed", "disabled"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """The ends of channels that an operator holds."""

    receivers: dict[str, Receiver[Any]] = field(default_factory=dict)
    senders: dict[str, Sender[Any]] = field(default_factory=dict)
    # Inputs that start epochs anew, none if the operator spans them; and those of them whose mark
    # answers the one that this operator sends.
    marked: tuple[str, ...] = ()
    marked_feedback: tuple[str, ...] = ()

    def close(self) -> None:
        for sender in self.senders.values():
            sender.close()
        for receiver in self.receivers.values():
            receiver.close()

    async def enter_next_epoch(self) -> bool:
        """If an input stands at the end of an epoch, take all of them to the next and mark the outputs.

        False if the operator returned for another reason, or if nothing follows.
        """
        marked = [self.receivers[port] for port in self.marked]
        if not any(receiver.is_at_epoch_end and len(receiver.channel) for receiver in marked):
            return False
        entered = [await receiver.enter_next_epoch() for receiver in marked]
        if not any(entered):
            return False
        for sender in self.senders.values():
            sender.start_epoch()
        for port in self.marked_feedback:
            await self.receivers[port].enter_next_epoch()
        return True


class Stage:
    """An operator at work."""

    def __init__(
        self,
        node: Node,
        ends: Ends,
        context: Context,
        *,
        policy: OnErrorSpec,
        on_failure: Callable[[OperatorError], None],
    ) -> None:
        self.node = node
        self.ends = ends
        self.context = context
        self.state: State = "waiting"
        self.errors: list[OperatorError] = []
        self._policy = policy
        self._on_failure = on_failure
        self._operator: Operator[Any, Any] | None = None
        self._scope = anyio.CancelScope()

    @property
    def activity(self) -> Activity:
        return self.context.activity

    @property
    def is_over(self) -> bool:
        return self.state in ("ended", "failed", "disabled")

    @property
    def is_at_rest(self) -> bool:
        """True if the operator does nothing but wait, as far as is known here."""
        return self.activity.num_running == 0

    async def run(self) -> None:
        """Run the operator to its end; then its outputs end too, and nobody reads its inputs."""
        set_context(self.context)
        self.state = "running"
        try:
            with self._scope:
                await self._attempts()
        finally:
            if self.state == "running":
                self.state = "ended"
            self.ends.close()

    def stop(self) -> None:
        """End the operator here and now; what it sent so far flows on."""
        self._scope.cancel()

    def fail(self, error: OperatorError) -> None:
        """End the operator with an error that it did not raise itself."""
        self._give_up(error)
        self._scope.cancel()

    def _give_up(self, error: OperatorError) -> None:
        self.errors.append(error)
        self.state = "failed"
        self._on_failure(error)

    async def _attempts(self) -> None:
        while True:
            try:
                await self.work()
            except Exception as cause:  # noqa: BLE001  # the border between operators and the run
                error = self._describe(cause)
                do = self._policy.do if len(self.errors) < self._policy.max else "stop"
            else:
                return
            if do == "stop":
                self._give_up(error)
                return
            self.errors.append(error)
            _log.warning("%s; %s", error, do)
            if do == "disable":
                self.state = "disabled"
                return
            if do == "restart":
                self._operator = None
                await anyio.sleep(self._policy.backoff_s * 2 ** (len(self.errors) - 1))

    async def work(self) -> None:
        """Make the operator and run it, anew in each epoch."""
        signature = self.node.signature
        inputs = _fill(signature.inputs_type, signature.inputs, self.ends.receivers)
        outputs = _fill(signature.outputs_type, signature.outputs, self.ends.senders)
        while True:
            if self._operator is None:
                self._operator = signature.make(self.node.config)
            await _timed(self._operator.run(inputs, outputs), self.activity)
            if not await self.ends.enter_next_epoch():
                return
            self._operator = None

    def _describe(self, cause: Exception) -> OperatorError:
        """Return an error that names the operator, what it read last, and its place in the file."""
        while isinstance(cause, ExceptionGroup):
            cause = cause.exceptions[0]
        if isinstance(cause, OperatorError):
            return cause
        after = ", ".join(f"{port} at stamp_ns {t}" for port, t in self.last_stamps().items())
        place = f"{self.node.position}: " if self.node.position else ""
        what = str(cause) if isinstance(cause, MappingError) else f"{type(cause).__name__}: {cause}"
        error = OperatorError(
            f"{place}operator {self.node.name!r} ({self.node.use}) failed after "
            f"{after or 'no message'}: {what}"
        )
        error.__cause__ = cause
        return error

    def last_stamps(self) -> dict[str, int]:
        """Return the stamp of the message that was taken last from each input."""
        stamps = {port: r.last_stamp_ns for port, r in self.ends.receivers.items()}
        return {port: stamp for port, stamp in stamps.items() if stamp is not None}


def _fill(ports_type: type[Any], names: Mapping[str, object], ends: Mapping[str, object]) -> Any:  # noqa: ANN401
    """Return the inputs or outputs of an operator; optional inputs that nobody feeds are None."""
    if issubclass(ports_type, Ports):
        return ports_type(**ends)
    return ports_type(**{name: ends.get(name) for name in names})


class _timed(Awaitable[None]):  # noqa: N801  # awaited like a function
    """Runs a coroutine and counts the time that the event loop spends in it."""

    def __init__(self, coroutine: Coroutine[Any, Any, None], activity: Activity) -> None:
        self._coroutine = coroutine
        self._activity = activity

    def __await__(self) -> Generator[Any, Any, None]:
        coroutine, activity = self._coroutine, self._activity
        error: BaseException | None = None
        while True:
            started_ns = monotonic_ns()
            try:
                waits_for = coroutine.send(None) if error is None else coroutine.throw(error)
            except StopIteration:
                return
            finally:
                activity.loop_ns += monotonic_ns() - started_ns
            error = None
            try:
                yield waits_for
            except BaseException as thrown:  # noqa: BLE001  # it belongs to the coroutine
                error = thrown
