"""What tests of graphs share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.graph.operators_for_tests import COLLECTED, GATES
from tests.graph.terminal import Terminal


@pytest.fixture
def mapstream(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Terminal:
    """The command line, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAPSTREAM_TRACEBACK", raising=False)
    return Terminal(capsys)


@pytest.fixture(autouse=True)
def _nothing_kept() -> Iterator[None]:
    """Forget what operators of a test kept in this process."""
    yield
    COLLECTED.clear()
    GATES.clear()
