"""What tests of graphs share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.graph.terminal import Terminal


@pytest.fixture
def mapstream(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Terminal:
    """The command line, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAPSTREAM_TRACEBACK", raising=False)
    return Terminal(capsys)
