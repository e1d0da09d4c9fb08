"""The thread that draws: the only one that calls Rerun."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from threading import Event
from typing import TYPE_CHECKING

from mapstream.graph.plan import Plan
from mapstream.graph.tap_outputs import Output, main_odometry
from mapstream.graph.tap_queue import Item, TapQueue
from mapstream.graph.tap_sinks import Sink

if TYPE_CHECKING:
    from mapstream.graph.views import Columns, Entry, Scene, ViewSettings

_log = logging.getLogger(__name__)

_FLUSH_BYTES = 16 * 2**20  # what Rerun may hold before it must have passed it on
_FLUSH_S = 0.5
_WAIT_S = 1.0  # between two attempts


class Artist:
    """Takes messages from a queue and draws them, until the queue has ended."""

    def __init__(
        self,
        plan: Plan,
        outputs: list[Output],
        queue: TapQueue,
        sink: Sink,
        settings: ViewSettings | None,
    ) -> None:
        self.num_drawn = 0
        self.errors: Counter[str] = Counter()
        self.has_asked = Event()  # the sink was asked once: Rerun is imported, which takes long
        self.is_over = Event()  # time is up
        self._plan = plan
        self._outputs = outputs
        self._queue = queue
        self._sink = sink
        self._settings = settings
        self._epochs: dict[str, int] = {}
        self._stamp_ns: int | None = None  # newest so far: the time of what has no time of its own
        self._waiting_bytes = 0
        self._flushed_s = time.monotonic()

    def run(self) -> None:
        """Draw until the end; what stops the drawing does not stop the run."""
        try:
            self._draw_all()
        except Exception as error:  # noqa: BLE001  # said at the end of the run
            _log.exception("drawing ended")
            self.errors[f"drawing ended: {error}"] += 1
        finally:
            self.has_asked.set()
            self._queue.abandon()

    def _draw_all(self) -> None:
        from mapstream.graph.blueprint import blueprint_of  # noqa: PLC0415  # imports rerun
        from mapstream.graph.views import Scene, ViewSettings  # noqa: PLC0415

        main = main_odometry(self._plan, self._outputs)
        scene = Scene(
            settings=self._settings or ViewSettings(),
            main_odometry=main.path if main else None,
        )
        blueprint = blueprint_of(self._plan, self._outputs)
        is_open = self._sink.try_open(blueprint)
        self.has_asked.set()
        if not is_open and not self._retry(lambda: self._sink.try_open(blueprint)):
            self.errors["no viewer answered"] += 1
            return
        while not self._queue.has_ended and not self.is_over.is_set():
            item = self._queue.take(_FLUSH_S)
            if item is not None:
                self._draw(item, scene)
                self._waiting_bytes += item.num_bytes
            is_due = time.monotonic() - self._flushed_s > _FLUSH_S
            if (is_due and not self._sink.is_file) or self._waiting_bytes > _FLUSH_BYTES:
                self._retry(self._flush)  # nothing may be drawn before it succeeds
        self._retry(self._flush)
        self._sink.close()

    def _draw(self, item: Item, scene: Scene) -> None:
        from mapstream.graph.views import operator_graph, view_of  # noqa: PLC0415

        message = item.message
        stamp_ns = getattr(message, "stamp_ns", self._stamp_ns)
        if stamp_ns is None:  # nothing has happened yet that it could be about
            return
        scene.path = item.path
        drawing: list[Entry | Columns] = []
        if self.num_drawn == 0:
            drawing += operator_graph(self._plan)
        try:
            if item.epoch != self._epochs.setdefault(item.path, item.epoch):
                drawing += scene.start_epoch()
            drawing += view_of(message)(message, scene)
            self._sink.draw(item.path, drawing, stamp_ns=stamp_ns, sequence=item.sequence)
        except Exception as error:  # noqa: BLE001  # a picture must not end the run: counted, shown
            _log.debug("drawing of %s failed", item.path, exc_info=True)
            self.errors[f"{item.path}: cannot draw {type(message).__name__}: {error}"] += 1
        self._epochs[item.path] = item.epoch
        self._stamp_ns = max(stamp_ns, stamp_ns if self._stamp_ns is None else self._stamp_ns)
        self.num_drawn += 1

    def _flush(self) -> bool:
        if not self._sink.flush(_WAIT_S):
            return False
        self._waiting_bytes = 0
        self._flushed_s = time.monotonic()
        return True

    def _retry(self, attempt: Callable[[], bool]) -> bool:
        """Call until it succeeds; False if time was up first."""
        while not attempt():
            if self.is_over.wait(_WAIT_S):
                return False
        return True
