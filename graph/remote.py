"""An operator in a process of its own, as the run sees it; `worker.py` is the other end.

The channels stay here, with their policies, limits and bounds. Messages cross as long as the other side
has credits, so that it holds one at work and one next; bounds, epochs and ends cross in order with them.
A process that dies is this operator's error: it names the signal and the message that was taken last.
"""

from __future__ import annotations

import logging
import os
import pickle
import socket
from collections import deque
from dataclasses import dataclass, field, fields
from typing import Any

import anyio

from mapstream.graph.crossing import ARRIVAL, CREDITS, CREDITS_BACK, STAMP
from mapstream.graph.order import NUM_FRAMES, Order, Outcome
from mapstream.graph.packing import pack, unpack
from mapstream.graph.pipe import Frame, Pipe
from mapstream.graph.ring import RingReader, RingWriter, make_memory
from mapstream.graph.stage import Stage
from mapstream.graph.worker_process import cause_of, start_worker
from mapstream.operators.operator import Activity
from mapstream.streams.channel import BEGINNING, Receiver, Sender
from mapstream.streams.clock import WallClock
from mapstream.streams.errors import MappingError, OperatorError
from mapstream.streams.waiting import Waiters

_RING_BYTES = 1 << 27  # of address space; memory is used as far as messages fill it
_PATIENCE_S = 5.0  # with a process whose operator is done


@dataclass(slots=True)
class _Feed:
    """An input on its way to the process."""

    receiver: Receiver[Any]
    credits: int = CREDITS
    room: Waiters = field(default_factory=Waiters)
    scope: anyio.CancelScope = field(default_factory=anyio.CancelScope)


@dataclass(slots=True)
class _Delivery:
    """An output that came from the process: messages, and what stands between them."""

    sender: Sender[Any]
    queue: deque[tuple[Frame, Any]] = field(default_factory=deque)
    filled: Waiters = field(default_factory=Waiters)
    num_taken: int = 0

    def try_send(self, message: object) -> bool:
        """Send at once if that is plainly possible, which spares a round of the event loop."""
        channels = self.sender.channels
        is_next = bool(self.filled) and not self.queue
        is_plain = type(self.sender) is Sender and len(channels) == 1
        return is_next and is_plain and channels[0].offer(message)

    def add(self, kind: Frame, value: object = None) -> None:
        self.queue.append((kind, value))
        self.filled.wake()


class ProcessDiedError(MappingError):
    """The process of an operator ended before the operator did."""


class RemoteStage(Stage):
    """Starts the process, feeds it, and delivers what it sends."""

    _pipe: Pipe | None = None  # to the present process
    _rest_at = -1  # how many frames the process had received when it had nothing more to do

    @property
    def is_at_rest(self) -> bool:
        return self._pipe is not None and self._pipe.num_sent == self._rest_at

    def stop(self) -> None:
        if self.node.is_source and self._pipe is not None:
            self._pipe.send(Frame.STOP)
        else:
            super().stop()

    def last_stamps(self) -> dict[str, int]:
        return self._taken

    async def work(self) -> None:
        """Run the operator in a new process until it is done.

        Raises:
            OperatorError: If the operator cannot be sent to a process.
            ProcessDiedError: If the process ends before the operator does.
        """
        self._rest_at = -1
        self._taken: dict[str, int] = {}
        self._feeds = [_Feed(receiver) for receiver in self.ends.receivers.values()]
        read = {name: s for name, s in self.ends.senders.items() if s.channels}
        self._deliveries = [_Delivery(sender) for sender in read.values()]
        self._outcome: Outcome | None = None
        self._broken: Exception | None = None
        self._over = anyio.Event()
        order = self._order(tuple(read))
        down, up = make_memory(_RING_BYTES), make_memory(_RING_BYTES)
        ours, theirs = socket.socketpair()
        self._writer, self._reader = RingWriter(down), RingReader(up)
        try:
            process = await start_worker(theirs.fileno(), down, up)
        finally:
            theirs.close()
            os.close(down)
            os.close(up)
        async with process:
            self._pipe = Pipe(ours, self._on_frame, self._on_end)
            try:
                self._pipe.send(Frame.START, 0, order)
                await self._pump()
                with anyio.move_on_after(_PATIENCE_S):
                    await process.wait()
            finally:
                self._pipe.close()
                self._pipe = None
                noted = {port: self._writer.noted(i) for i, port in enumerate(self.ends.receivers)}
                self._taken = {port: stamp for port, stamp in noted.items() if stamp is not None}
                del self._writer, self._reader  # the memory lives as long as messages look into it
                if process.returncode is None:
                    process.kill()
        self._settle(process.returncode)

    def _order(self, outputs: tuple[str, ...]) -> bytes:
        order = Order(
            node=self.node,
            policy=self._policy,
            inputs=tuple(self.ends.receivers),
            outputs=outputs,
            marked=self.ends.marked,
            marked_feedback=self.ends.marked_feedback,
            has_wall_clock=isinstance(self.context.clock, WallClock),
            log_level=logging.getLogger().getEffectiveLevel(),
        )
        try:
            return pickle.dumps(order)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise OperatorError(
                f"operator {self.node.name!r} ({self.node.use}) cannot run in a process of its own: "
                f"{error}; define it at the top of a module, or write `run: thread`"
            ) from error

    async def _pump(self) -> None:
        """Feed the process and deliver what it sends, until it is done or gone."""
        async with anyio.create_task_group() as feeding:
            for number, feed in enumerate(self._feeds):
                feeding.start_soon(self._feed, number, feed)
            self._clock_tasks = feeding
            async with anyio.create_task_group() as delivering:
                for number, delivery in enumerate(self._deliveries):
                    delivering.start_soon(self._deliver, number, delivery)
                await self._over.wait()
                for delivery in self._deliveries:
                    delivery.add(Frame.DONE)
            feeding.cancel_scope.cancel()

    async def _feed(self, number: int, feed: _Feed) -> None:
        receiver, pipe = feed.receiver, self._pipe
        assert pipe is not None  # noqa: S101  # it is made before this task
        epoch, bound_ns = receiver.epoch, BEGINNING
        with feed.scope:
            while True:
                while feed.credits == 0:
                    await feed.room.wait()
                message = receiver.try_receive()
                for _ in range(receiver.epoch - epoch):
                    pipe.send(Frame.EPOCH, number)
                epoch = receiver.epoch
                if message is not None:
                    feed.credits -= 1
                    arrival = receiver.arrival
                    bound_ns = arrival.bound_ns
                    head = ARRIVAL.pack(arrival.sequence, arrival.arrived_ns, bound_ns)
                    pipe.send(Frame.MESSAGE, number, head + pack(message, self._writer))
                    del message  # so that memory in a ring is free while this waits
                    continue
                if receiver.has_ended:
                    pipe.send(Frame.CLOSE, number)
                    return
                if receiver.bound_ns != bound_ns:
                    bound_ns = receiver.bound_ns
                    pipe.send(Frame.BOUND, number, STAMP.pack(bound_ns), lazily=True)
                await receiver.wait()
        receiver.close()

    async def _deliver(self, number: int, delivery: _Delivery) -> None:
        sender = delivery.sender
        while True:
            while not delivery.queue:
                await delivery.filled.wait()
            kind, value = delivery.queue.popleft()
            match kind:
                case Frame.MESSAGE:
                    await sender.send(value)
                    del value  # so that its memory in the ring is free while this waits
                    self._count(number, delivery)
                case Frame.BOUND:
                    sender.advance(value)
                case Frame.EPOCH:
                    sender.start_epoch()
                case Frame.CLOSE:
                    sender.close()
                case _:
                    return

    def _count(self, number: int, delivery: _Delivery) -> None:
        """Give credits for messages that were delivered, several at a time."""
        delivery.num_taken += 1
        if self._pipe is not None and delivery.num_taken % (CREDITS_BACK // 2) == 0:
            self._pipe.send(Frame.CREDIT, number, lazily=True)

    def _on_frame(self, kind: Frame, port: int, body: memoryview) -> None:
        match kind:
            case Frame.MESSAGE:
                delivery, message = self._deliveries[port], unpack(body, self._reader)
                if delivery.try_send(message):
                    self._count(port, delivery)
                else:
                    delivery.add(kind, message)
            case Frame.BOUND:
                self._deliveries[port].add(kind, *STAMP.unpack(body))
            case Frame.EPOCH | Frame.CLOSE:
                self._deliveries[port].add(kind)
            case Frame.CREDIT:
                feed = self._feeds[port]
                feed.credits += 1
                feed.room.wake()
            case Frame.ABANDON:
                self._feeds[port].scope.cancel()
            case Frame.SLEEP:
                self._clock_tasks.start_soon(self._sleep, port, *STAMP.unpack(body))
            case _:
                self._on_report(kind, body)

    def _on_end(self, broken: Exception | None) -> None:
        self._broken = broken
        self._over.set()

    def _on_report(self, kind: Frame, body: memoryview) -> None:
        match kind:
            case Frame.ACTIVITY:
                self._copy(pickle.loads(body))  # noqa: S301  # our own program wrote it
            case Frame.REST:
                (self._rest_at,) = NUM_FRAMES.unpack(body)
            case Frame.LOG:
                record = logging.makeLogRecord(pickle.loads(body))  # noqa: S301  # the same
                logger = logging.getLogger(record.name)
                if logger.isEnabledFor(record.levelno):
                    logger.handle(record)
            case Frame.DONE:
                self._outcome = pickle.loads(body)  # noqa: S301  # the same
            case _:
                raise ValueError(f"a {kind.name} frame is not for this side")

    def _copy(self, activity: Activity) -> None:
        for part in fields(Activity):
            setattr(self.activity, part.name, getattr(activity, part.name))

    async def _sleep(self, number: int, stamp_ns: int) -> None:
        await self.context.clock.sleep_until(stamp_ns)
        if self._pipe is not None:
            self._pipe.send(Frame.WOKEN, number, STAMP.pack(self.context.clock.now_ns()))

    def _settle(self, returncode: int | None) -> None:
        """Take over how the operator ended, or raise what ended its process."""
        outcome = self._outcome
        if self._broken is not None:
            raise ProcessDiedError("what its process sent cannot be read") from self._broken
        if outcome is None:
            raise ProcessDiedError(f"its process {cause_of(returncode)}")
        self._copy(outcome.activity)
        errors = [OperatorError(text) for text in outcome.errors]
        if errors:
            errors[-1].add_note(f"In the process of {self.node.name!r}:\n{outcome.trace}")
        if outcome.state == "failed":
            self.errors += errors[:-1]
            self._give_up(errors[-1])
            return
        self.errors += errors
        if outcome.state == "disabled":
            self.state = "disabled"
