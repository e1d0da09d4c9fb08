"""What every test shares."""

import pytest
from hypothesis import settings

# The same examples every time, and no deadline: a busy machine is no failure.
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, database=None, max_examples=50
)
settings.load_profile("repeatable")


@pytest.fixture
def anyio_backend() -> str:
    """Async tests run on asyncio, as the product does."""
    return "asyncio"
