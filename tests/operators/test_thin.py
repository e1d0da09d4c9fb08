"""One message of each period goes on, and none is lost."""

from __future__ import annotations

import pytest

from mapstream.operators.flow.thin import Thin, ThinConfig
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry

pytestmark = pytest.mark.anyio


async def thinned(stamps_ns: list[int], period_s: float) -> tuple[list[int], list[int]]:
    config = ThinConfig(period_s=period_s)
    messages = [Odometry(stamp_ns=s, T_odom_base=SE3.identity()) for s in stamps_ns]
    sent = await run_operator(Thin(config), config=config, messages=messages)
    return [m.stamp_ns for m in sent["kept"]], [m.stamp_ns for m in sent["rest"]]


async def test_the_first_of_each_period_is_kept_whatever_the_jitter() -> None:
    """Periods are counted from the first message, so that early ones do not push the next away."""
    kept, rest = await thinned([100, 109, 121, 129, 130, 139, 151], 1e-8)

    assert kept == [100, 121, 130, 151]
    assert rest == [109, 129, 139]


async def test_a_period_without_a_message_is_no_debt() -> None:
    kept, rest = await thinned([0, 95, 96, 101], 1e-8)

    assert (kept, rest) == ([0, 95, 101], [96])
