"""Commands in processes of their own that begin with everything imported: a page has many, each short."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_SERVER = """
import json, os, sys, tempfile
from mapstream.graph.cli import main
import scipy.sparse.csgraph  # what most commands need, before the fork
import mapstream.graph.cli.map, mapstream.graph.cli.run, mapstream.operators.estimation.batch

for line in sys.stdin:
    with tempfile.TemporaryFile("w+") as output:
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            code = 70
            try:
                main(json.loads(line))
            except SystemExit as leaves:
                code = int(leaves.code or 0)
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        _, status = os.waitpid(child, 0)
        output.seek(0)
        print(json.dumps([os.waitstatus_to_exitcode(status), output.read()]), flush=True)
"""


@dataclass(frozen=True)
class Ended:
    """What a command did."""

    code: int
    output: str  # standard output and error


@contextmanager
def command_line(
    folder: Path, environment: dict[str, str]
) -> Iterator[Callable[[Sequence[str]], Ended]]:
    """Yield what runs `mapstream` commands, one after another in a folder."""
    with subprocess.Popen(
        [sys.executable, "-c", _SERVER],
        cwd=folder,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as server:
        commands, results = server.stdin, server.stdout
        assert commands is not None
        assert results is not None

        def run(words: Sequence[str]) -> Ended:
            print(json.dumps(list(words)), file=commands, flush=True)
            return Ended(*json.loads(results.readline()))

        yield run
