"""Starting the process of an operator, and reading from its end what ended it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import anyio
import anyio.abc

# One thread per process: the processes are the parallelism. The libraries read these when they load.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_ENVIRONMENT = dict.fromkeys(_THREADS, "1")


async def start_worker(*descriptors: int) -> anyio.abc.Process:
    """Start `worker.py` with these descriptors and our import path; spawned, as few libraries survive a fork."""
    path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
    return await anyio.open_process(
        [sys.executable, "-P", "-m", "mapstream.graph.worker", *map(str, descriptors)],
        stdin=subprocess.DEVNULL,
        stdout=2,  # what C++ prints must not mix with the output of a command
        stderr=None,
        env=os.environ | _ENVIRONMENT | {"PYTHONPATH": path},
        start_new_session=True,  # Ctrl-C in a terminal is for the parent alone
        pass_fds=descriptors,
    )


def cause_of(returncode: int | None) -> str:
    """Return how a process ended, as the rest of a sentence that begins with it."""
    if returncode is None or returncode >= 0:
        return f"ended with code {returncode} before the operator did"
    name = signal.Signals(-returncode).name
    hints = {
        "SIGKILL": "; the system may have run out of memory",
        "SIGABRT": "; a C++ library gave up, its message is above",
        "SIGSEGV": "; a C++ library crashed",
    }
    return f"was ended by {name}{hints.get(name, '')}"
