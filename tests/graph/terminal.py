"""The command line as a test sees it: words in, an exit code and two texts out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import pytest

from mapstream.graph.cli import main


@dataclass(frozen=True)
class Done:
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:  # noqa: ANN401  # whatever the verb tells
        return json.loads(self.out)


class Terminal:
    """Runs commands in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: object) -> Done:
        with pytest.raises(SystemExit) as caught:
            main([str(word) for word in words])
        out, err = self._capsys.readouterr()
        return Done(int(caught.value.code or 0), out, err)
