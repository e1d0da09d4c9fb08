"""Copies what flows through a run to Rerun, and never slows mapping.

The runtime shows the tap each message as it is sent. The tap puts a reference into a bounded queue, one
thread takes from it and draws. Messages are immutable, so nothing is copied on the way.
While a recording is replayed into a file, the queue waits rather than lose anything: the file is a result.
In all other cases it loses messages rather than time (`tap_queue.py` says which), and counts them.
"""

from __future__ import annotations

from threading import Thread
from typing import TYPE_CHECKING, Any, Self

from mapstream.graph.tap_drawing import Artist
from mapstream.graph.tap_outputs import drawn_outputs
from mapstream.graph.tap_queue import TapQueue
from mapstream.graph.tap_sinks import Sink

if TYPE_CHECKING:
    from mapstream.graph.metrics import Snapshot
    from mapstream.graph.plan import Edge, Plan
    from mapstream.graph.views import ViewSettings
    from mapstream.streams.channel import Arrival

MAX_BYTES = 256 * 2**20
_IMPORT_S = 30.0  # of Rerun, on a busy machine
_FAREWELL_S = 3.0  # for the last flush and the closing of the sink
RUN_PATH = "run"  # rates, queues and the operator graph


class RerunTap:
    """A tap for `run_graph`, with its `on_progress`; close it after the run.

    Args:
        plan: The run. Its `log.rerun` says which outputs are drawn.
        sink: Where drawings go.
        settings: How much detail; None: the defaults.
        max_bytes: Of messages that wait to be drawn.
        max_rate_hz: Of scans and images, per output, unless nothing may be lost.
    """

    def __init__(
        self,
        plan: Plan,
        sink: Sink,
        *,
        settings: ViewSettings | None = None,
        max_bytes: int = MAX_BYTES,
        max_rate_hz: float = 15.0,
    ) -> None:
        is_lossless = sink.is_file and plan.profile.clock.from_ == "data"
        self.queue = TapQueue(max_bytes, is_lossless=is_lossless, max_rate_hz=max_rate_hz)
        outputs = drawn_outputs(plan)
        self._paths = {output.edge.name: output.path for output in outputs}
        self._sink = sink
        self._artist = Artist(plan, outputs, self.queue, sink, settings)
        self._thread = Thread(target=self._artist.run, name="rerun", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, edge: Edge, message: Any, arrival: Arrival) -> None:  # noqa: ANN401  # of any type
        path = self._paths.get(edge.name)
        if path is not None:
            self.queue.put(path, message, arrival.epoch)

    def on_progress(self, snapshot: Snapshot) -> None:
        """Draw how the run goes."""
        self.queue.put(RUN_PATH, snapshot)

    def close(self) -> None:
        """Draw what waits, and end; a sink that does not get on for its `patience_s` loses the rest."""
        self.queue.close()
        self._artist.has_asked.wait(_IMPORT_S)
        num_drawn = -1
        while self._thread.is_alive() and self._artist.num_drawn > num_drawn:
            num_drawn = self._artist.num_drawn
            self._thread.join(self._sink.patience_s)
        self.queue.abandon()
        self._artist.is_over.set()
        self._thread.join(min(_FAREWELL_S, self._sink.patience_s))
        if self._thread.is_alive():
            self._leave_behind()

    def notes(self) -> list[str]:
        """Return what is missing from the picture and why; nothing if all is there."""
        lost = sorted(self.queue.lost.items())
        notes = [f"rerun: {path}: {n} messages not drawn ({reason})" for (path, reason), n in lost]
        return notes + [f"rerun: {error} ({n} times)" for error, n in self._artist.errors.items()]

    def _leave_behind(self) -> None:
        """Let the process end though a viewer does not read: Rerun would wait for it for ever.

        The thread is a daemon, and it alone refers to the stream.
        """
        import rerun as rr  # noqa: PLC0415  # only those who look pay for the import

        rr.unregister_shutdown()
        self._artist.errors["the viewer did not take the last drawings"] += 1
