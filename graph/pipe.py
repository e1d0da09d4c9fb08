"""Frames through a socket pair between two processes, each on its own event loop."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from enum import IntEnum

_HEAD = struct.Struct("<IBH")  # length of the body, kind, port
_CHUNK = 1 << 16


class Frame(IntEnum):
    """What a frame says; the port is one of the receiver's or sender's, by number."""

    START = 0  # to the child: what to run
    MESSAGE = 1
    BOUND = 2
    EPOCH = 3
    CLOSE = 4
    CREDIT = 5  # one message of this port was taken; another may be sent
    ABANDON = 6  # to the parent: nobody reads this input any more
    STOP = 7  # to the child: a source should end
    SLEEP = 8  # to the parent: wake me at this event time
    WOKEN = 9
    ACTIVITY = 10  # to the parent: what was done so far
    LOG = 11
    REST = 12  # to the parent: nothing to do until one of these inputs has more
    DONE = 13  # to the parent: how it ended


class Pipe:
    """One end. A frame that is sent lazily goes with the next one, or two rounds of the loop later.

    Each write wakes the other process, which costs more than all the rest of a small frame.
    """

    def __init__(
        self,
        end: socket.socket,
        on_frame: Callable[[Frame, int, memoryview], None],
        on_end: Callable[[Exception | None], None],  # with what was wrong with a frame, if so
    ) -> None:
        end.settimeout(0.0)
        self.num_received = 0
        self.num_sent = 0
        self._socket = end
        self._on_frame = on_frame
        self._on_end = on_end
        self._chunk = memoryview(
            bytearray(_CHUNK)
        )  # a new buffer for each read costs more than the read
        self._inbox = bytearray()
        self._outbox = bytearray()
        self._is_flush_due = False
        self._is_blocked = False
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(end, self._read)

    def send(self, kind: Frame, port: int = 0, body: bytes = b"", *, lazily: bool = False) -> None:
        """Send a frame; after the other end is gone this does nothing."""
        self.num_sent += 1
        self._outbox += _HEAD.pack(len(body), kind, port)
        self._outbox += body
        if not lazily:
            self._flush()
        elif not self._is_flush_due:
            self._is_flush_due = True
            self._loop.call_soon(self._loop.call_soon, self._flush)

    def finish(self) -> None:
        """Send what is left, however long the other end takes to read it, and close."""
        self._socket.settimeout(None)
        self._socket.sendall(self._outbox)
        self.close()

    def close(self) -> None:
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket.close()

    def _flush(self) -> None:
        self._is_flush_due = False
        if not self._outbox or self._is_blocked or self._socket.fileno() < 0:
            return
        try:
            sent = self._socket.send(self._outbox)
        except BlockingIOError:
            sent = 0
        except ConnectionError:  # the reading side will tell
            self._outbox.clear()
            return
        del self._outbox[:sent]
        if self._outbox:
            self._is_blocked = True
            self._loop.add_writer(self._socket, self._write_on)

    def _write_on(self) -> None:
        self._loop.remove_writer(self._socket)
        self._is_blocked = False
        self._flush()

    def _read(self) -> None:
        try:
            size = self._socket.recv_into(self._chunk)
        except BlockingIOError:
            return
        except ConnectionError:
            size = 0
        if size == 0:
            self.close()
            self._on_end(None)
            return
        self._inbox += self._chunk[:size]
        start = 0
        while len(self._inbox) - start >= _HEAD.size:
            length, kind, port = _HEAD.unpack_from(self._inbox, start)
            end = start + _HEAD.size + length
            if len(self._inbox) < end:
                break
            self.num_received += 1
            body = memoryview(bytes(self._inbox[start + _HEAD.size : end]))
            try:
                self._on_frame(Frame(kind), port, body)
            except Exception as error:  # noqa: BLE001  # in a callback it would be lost
                self.close()
                self._on_end(error)
                return
            start = end
        del self._inbox[:start]
