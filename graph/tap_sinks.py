"""Where drawings go: a file, or a viewer that may be slow, stopped or absent.

Of rerun-sdk 0.41 this must be known (all measured): with a viewer that does not read, `log` blocks for ever once some
70 MB wait, and so do `disconnect` and the end of the process; `save` keeps what it has not written in memory, without
a bound. So nothing is logged while a flush is due, and a sink that cannot be flushed is never closed.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import timedelta
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol
from urllib.parse import urlparse

import numpy as np

from mapstream.streams.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable

    import rerun as rr

    from mapstream.graph.views.scene import Columns, Entry

DEFAULT_URL = "rerun+http://127.0.0.1:9876/proxy"
_APPLICATION = "mapstream"
_FILE_TICK = timedelta(seconds=10)
_FILE_CHUNK_BYTES = 8 * 2**20


class Sink(Protocol):
    """Takes drawings, from one thread."""

    @property
    def is_file(self) -> bool:
        """True if it takes everything, in its own time: what draws for it may be waited for."""
        ...

    @property
    def patience_s(self) -> float:
        """How long the end of a run waits for it without progress."""
        ...

    def try_open(self, blueprint: Any) -> bool:  # noqa: ANN401  # of rerun, which is imported late
        """Return whether drawings can come; else ask again."""
        ...

    def draw(
        self, path: str, drawing: Iterable[Entry | Columns], *, stamp_ns: int, sequence: int
    ) -> None:
        """Take one message's drawing; paths in it are relative to `path`."""
        ...

    def flush(self, timeout_s: float) -> bool:
        """Pass on what was drawn; False if that takes longer. Then nothing must be drawn."""
        ...

    def close(self) -> None:
        """End after a flush that succeeded."""
        ...


@dataclass(frozen=True, slots=True)
class SinkSpec:
    """What the user asked for: `spawn`, `connect`, `connect=URL`, `save=FILE` or `off`."""

    kind: Literal["spawn", "connect", "save", "off"]
    target: str = ""

    @classmethod
    def parse(cls, text: str) -> SinkSpec:
        """Return the sink that the text names.

        Raises:
            ConfigError: If it names none, or one that cannot work here.
        """
        kind, _, target = text.partition("=")
        if kind == "save" and target:
            if not Path(target).absolute().parent.is_dir():
                raise ConfigError(f"rerun: {target}: there is no folder {Path(target).parent}")
            return cls("save", target)
        if kind == "connect":
            url = urlparse(target or DEFAULT_URL)
            if url.scheme.startswith("rerun") and url.hostname:
                return cls("connect", target or DEFAULT_URL)
            raise ConfigError(f"rerun: expected a url like {DEFAULT_URL}, got {target!r}")
        if text == "spawn":
            return cls("spawn", DEFAULT_URL)
        if text == "off":
            return cls("off")
        raise ConfigError(
            f"rerun: expected spawn, connect, connect=URL, save=FILE or off, got {text!r}"
        )

    def open(self) -> RerunSink:
        """Return the sink; it opens when the first drawing comes.

        Raises:
            ConfigError: If a viewer is asked for where no window can open.
        """
        if self.kind == "spawn" and not _has_display():
            raise ConfigError("rerun: no display to open a viewer on; try save=FILE or connect=URL")
        return RerunSink(self)


class RerunSink:
    """A Rerun recording."""

    def __init__(self, spec: SinkSpec) -> None:
        self.spec = spec
        self._stream: rr.RecordingStream | None = None
        self._viewer: subprocess.Popen[bytes] | None = None

    @property
    def is_file(self) -> bool:
        return self.spec.kind == "save"

    @property
    def patience_s(self) -> float:
        if self.spec.kind == "connect":
            return 5.0 if self._stream else 0.5
        return 20.0  # a window opens slowly, a disk may be busy

    def try_open(self, blueprint: Any) -> bool:  # noqa: ANN401
        import rerun as rr  # noqa: PLC0415  # 0.7 s and 80 MB, only for those who look

        if not self.is_file and not self._is_viewer_there():
            return False
        batches = rr.ChunkBatcherConfig()
        if self.is_file:  # a viewer opens few large chunks many times faster than many small ones
            batches.flush_tick = _FILE_TICK
            batches.flush_num_bytes = _FILE_CHUNK_BYTES
        stream = rr.RecordingStream(_APPLICATION, batcher_config=batches)
        if self.is_file:
            stream.save(self.spec.target, default_blueprint=blueprint)
        else:
            stream.connect_grpc(self.spec.target, default_blueprint=blueprint)
        self._stream = stream
        return True

    def _is_viewer_there(self) -> bool:
        if (
            self.spec.kind == "spawn"
            and self._viewer is None
            and not is_listening(self.spec.target)
        ):
            self._viewer = spawn_viewer(self.spec.target)
        return is_listening(self.spec.target)

    def draw(
        self, path: str, drawing: Iterable[Entry | Columns], *, stamp_ns: int, sequence: int
    ) -> None:
        from mapstream.graph.views.scene import Columns  # noqa: PLC0415  # imports rerun

        stream = self._stream
        if stream is None:
            raise RuntimeError("a sink draws only after it was opened")
        for entry in drawing:
            entity = (
                entry.path if entry.path.startswith("/") else f"{path}/{entry.path}".rstrip("/")
            )
            if isinstance(entry, Columns):
                self._draw_columns(stream, entity, entry, sequence)
                continue
            # The times are set before each call, since Rerun keeps them per thread and stream.
            stream.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"))
            stream.set_time("seq", sequence=sequence)
            first, *more = entry.archetypes
            stream.log(entity, first, *more, static=entry.is_static)

    def _draw_columns(
        self, stream: rr.RecordingStream, entity: str, entry: Columns, sequence: int
    ) -> None:
        import rerun as rr  # noqa: PLC0415

        stamps = rr.TimeColumn("stamp", timestamp=entry.stamps_ns.astype("datetime64[ns]"))
        order = rr.TimeColumn("seq", sequence=np.full(len(entry.stamps_ns), sequence))
        stream.send_columns(entity, indexes=[stamps, order], columns=entry.columns)

    def flush(self, timeout_s: float) -> bool:
        if self._stream is None:
            return True
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError:  # the only error that it raises: not all was sent in time
            return False
        return True

    def close(self) -> None:
        if self._stream is not None:
            self._stream.disconnect()
            self._stream = None


def spawn_viewer(url: str, *arguments: str) -> subprocess.Popen[bytes]:
    """Open a viewer that outlives this process and listens on this machine alone.

    Rerun's own `spawn` needs the program in PATH and listens to the whole network.
    """
    program = files("rerun_cli") / ("rerun.exe" if sys.platform == "win32" else "rerun")
    port = str(urlparse(url).port)
    options = [
        "--port",
        port,
        "--bind",
        "127.0.0.1",
        "--memory-limit",
        "50%",
        "--hide-welcome-screen",
    ]
    return subprocess.Popen(  # noqa: S603  # no shell, and the program is the wheel's
        [str(program), *options, "--expect-data-soon", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env=os.environ | {"RERUN_APP_ONLY": "true"},
    )


def wait_until_listening(url: str, timeout_s: float = 20.0) -> bool:
    """Return whether something listens at the url before the time is over."""
    end_s = time.monotonic() + timeout_s
    while not is_listening(url):
        if time.monotonic() > end_s:
            return False
        time.sleep(0.1)
    return True


def is_listening(url: str) -> bool:
    """Return whether something listens at the url: Rerun's own connect would wait for ever."""
    parts = urlparse(url)
    try:
        socket.create_connection((parts.hostname, parts.port or 9876), timeout=1.0).close()
    except OSError:
        return False
    return True


def _has_display() -> bool:
    is_windowed = sys.platform in ("darwin", "win32")
    return is_windowed or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
