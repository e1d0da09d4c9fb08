"""Weights of networks for tests, where they are installed."""

from __future__ import annotations

import os

import pytest

from mapstream.operators.networks.catalogue import NETWORKS
from mapstream.operators.networks.checkpoints import Weights
from mapstream.operators.networks.install import install
from mapstream.operators.networks.installed import weights_file, weights_of

_FETCH = "MAPSTREAM_TEST_FETCH"


def installed(*names: str) -> list[Weights]:
    """Return weights; the test is skipped where they are not installed, unless the environment lets us fetch them."""
    missing = [NETWORKS[name] for name in names if not weights_file(NETWORKS[name]).is_file()]
    if missing and os.environ.get(_FETCH):
        install(missing)
    elif missing:
        pytest.skip(
            f"network {missing[0].name} is not installed: `mapstream models install` (or set {_FETCH}=1)"
        )
    return [weights_of(name) for name in names]
