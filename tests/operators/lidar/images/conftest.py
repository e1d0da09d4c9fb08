"""One drive for all tests of this folder."""

import pytest

from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.lidar.images.corridors import Drive, spin, tracked


@pytest.fixture(scope="session")
def drive() -> Drive:
    return spin(num_scans=14)


@pytest.fixture(scope="session")
def tracks(drive: Drive) -> list[ImageFeatures]:
    return tracked(drive)
