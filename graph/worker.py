"""The program of a process that runs one operator: `python -m mapstream.graph.worker SOCKET DOWN UP`.

The numbers are descriptors: of the pipe to the parent, and of the memory in each direction. The operator
does not know where it is; it reads receivers and writes senders as ever.
"""

from __future__ import annotations

import asyncio
import logging
import logging.handlers
import os
import pickle
import queue
import signal
import socket
import sys
import time
import traceback
from collections.abc import Sequence
from typing import Any

import anyio
import anyio.lowlevel

from mapstream.graph.crossing import ARRIVAL, CREDITS_BACK, STAMP, Inlet, Outlet, ParentClock
from mapstream.graph.metrics import resident_bytes
from mapstream.graph.order import NUM_FRAMES, Order, Outcome
from mapstream.graph.packing import unpack
from mapstream.graph.pipe import Frame, Pipe
from mapstream.graph.ring import RingReader, RingWriter
from mapstream.graph.stage import Ends, Stage, State
from mapstream.operators.operator import Activity, Context
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.clock import Clock, WallClock

_REPORT_PERIOD_S = 0.05


class _LogToParent(logging.handlers.QueueHandler):
    """Records go to the parent's loggers of the same names."""

    def __init__(self, pipe: Pipe) -> None:
        super().__init__(queue.SimpleQueue())
        self._pipe = pipe
        self._loop = asyncio.get_running_loop()

    def enqueue(self, record: logging.LogRecord) -> None:
        body = pickle.dumps(record.__dict__)
        self._loop.call_soon_threadsafe(self._pipe.send, Frame.LOG, 0, body)


def _give_up(broken: Exception | None) -> None:
    """End at once: without a parent there is nobody to work for."""
    if broken is not None:
        traceback.print_exception(broken)
    os._exit(1)


class _Worker:
    """The operator, and what reaches it through the pipe."""

    def __init__(self, end: socket.socket, down: int, up: int) -> None:
        self._reader = RingReader(down)
        self._writer = RingWriter(up)
        self._ordered = anyio.Event()
        self._inlets: list[Inlet] = []
        self._outlets: list[Outlet] = []
        self._stage: Stage  # from the first frame on
        self._pipe = Pipe(end, self._on_frame, _give_up)
        self._clock = ParentClock(self._pipe)

    async def run(self) -> None:
        await self._ordered.wait()
        stage = self._stage
        async with anyio.create_task_group() as background:
            background.start_soon(self._report, stage)
            await stage.run()
            background.cancel_scope.cancel()
        await anyio.lowlevel.checkpoint()  # for records on their way
        self._conclude(stage.state, stage.errors, self._activity(stage))

    def _conclude(self, state: State, errors: Sequence[Exception], activity: Activity) -> None:
        outcome = Outcome(
            state=state,
            errors=tuple(map(str, errors)),
            trace="".join(traceback.format_exception(errors[-1])) if errors else "",
            activity=activity,
        )
        self._pipe.send(Frame.DONE, 0, pickle.dumps(outcome))
        self._pipe.finish()

    def _begin(self, body: memoryview) -> None:
        """Make the stage, at once: the messages for it may be in the pipe already."""
        try:
            order: Order = pickle.loads(body)  # noqa: S301  # the parent is this same program
        except (ImportError, AttributeError) as error:  # the operator's module is not for import
            error.add_note("The operator's module cannot be imported in another process.")
            self._conclude("failed", [error], Activity())
            os._exit(1)
        logging.getLogger().setLevel(order.log_level)
        logging.getLogger().addHandler(_LogToParent(self._pipe))
        self._stage = self._make(order)
        self._ordered.set()

    def _make(self, order: Order) -> Stage:
        pipe, node = self._pipe, order.node
        spans_epochs = node.signature.operator_type.spans_epochs
        self._inlets = [
            Inlet(name, number, pipe, self._reader) for number, name in enumerate(order.inputs)
        ]
        self._outlets = [Outlet(i, pipe, self._writer) for i in range(len(order.outputs))]
        senders: dict[str, Sender[Any]] = {name: Sender() for name in node.signature.outputs}
        senders.update(zip(order.outputs, self._outlets, strict=True))
        clock: Clock = WallClock() if order.has_wall_clock else self._clock
        return Stage(
            node,
            Ends(
                receivers={i.name: Receiver(i, spans_epochs=spans_epochs) for i in self._inlets},
                senders=senders,
                marked=order.marked,
                marked_feedback=order.marked_feedback,
            ),
            Context(name=node.name, clock=clock, placement="process", workers=node.workers),
            policy=order.policy,
            on_failure=lambda _: None,
        )

    def _on_frame(self, kind: Frame, port: int, body: memoryview) -> None:
        match kind:
            case Frame.MESSAGE:
                message = unpack(body[ARRIVAL.size :], self._reader)
                self._inlets[port].deliver(message, ARRIVAL.unpack_from(body))
            case Frame.CREDIT:
                self._outlets[port].add_credits(CREDITS_BACK // 2)
            case Frame.BOUND:
                self._inlets[port].advance(*STAMP.unpack(body))
            case Frame.EPOCH:
                self._inlets[port].start_epoch()
            case Frame.CLOSE:
                self._inlets[port].close()
            case Frame.WOKEN:
                self._clock.wake(port, *STAMP.unpack(body))
            case Frame.STOP:
                self._stage.stop()
            case Frame.START:
                self._begin(body)
            case _:
                raise ValueError(f"a {kind.name} frame is not for this side")

    def _activity(self, stage: Stage) -> Activity:
        stage.activity.cpu_ns = time.process_time_ns()
        stage.activity.rss_bytes = resident_bytes()
        return stage.activity

    async def _report(self, stage: Stage) -> None:
        """Tell the parent what was done, and when there is nothing to do until it sends more."""
        before, told_at = (-1, -1), -1
        while True:
            await anyio.sleep(_REPORT_PERIOD_S)
            now = (self._pipe.num_received, self._pipe.num_sent)
            if now != before:
                self._pipe.send(Frame.ACTIVITY, 0, pickle.dumps(self._activity(stage)))
            elif told_at != self._pipe.num_received and self._is_at_rest(stage):
                told_at = self._pipe.num_received
                self._pipe.send(Frame.REST, 0, NUM_FRAMES.pack(told_at))
            before = (self._pipe.num_received, self._pipe.num_sent)

    def _is_at_rest(self, stage: Stage) -> bool:
        waits = any(i.is_receiver_waiting for i in self._inlets) or any(
            outlet.room for outlet in self._outlets
        )
        return waits and stage.is_at_rest and not self._clock.has_sleepers


def main() -> None:
    """Run the operator that the parent orders, and end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    end, down, up = (int(argument) for argument in sys.argv[1:4])

    async def work() -> None:
        await _Worker(socket.socket(fileno=end), down, up).run()

    anyio.run(work)


if __name__ == "__main__":
    main()
