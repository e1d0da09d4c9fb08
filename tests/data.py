"""Real recordings that may be on this machine; none of them is in the repository."""

import os
from pathlib import Path

import pytest

_DATA = Path(os.environ.get("MAPSTREAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


def shared(name: str) -> Path:
    """Return a file or folder of the shared data; the test is skipped where it is absent."""
    path = _DATA / name
    if not path.exists():
        pytest.skip(f"no {name} among the shared data (set MAPSTREAM_DATA)")
    return path


def model(name: str) -> Path:
    """Return a network that lies beside the shared data; the test is skipped where it is absent."""
    path = _DATA.parent / "models" / name
    if not path.exists():
        pytest.skip(f"no network {name} in the folder models beside the shared data")
    return path
