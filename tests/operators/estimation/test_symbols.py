from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.estimation.symbols import PoseSymbols
from mapstream.streams.errors import EstimationError

STAMPS = st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=50)


@given(STAMPS)
def test_B7_one_symbol_per_stamp_both_ways(stamps: list[int]) -> None:
    """The same stamp gives the same symbol, stamps 1 ns apart differ, and the way back is exact."""
    symbols = PoseSymbols()

    given_out = {stamp: symbols.pose_at("m", stamp) for stamp in stamps}

    assert all(symbols.pose_at("m", stamp) == symbol for stamp, symbol in given_out.items())
    assert all(symbols.place_of(symbol) == ("m", stamp) for stamp, symbol in given_out.items())
    assert len(set(given_out.values())) == len(set(stamps)) == len(symbols)
    assert symbols.pose_at("m", stamps[0] + 1) == given_out.get(stamps[0] + 1, len(set(stamps)))


@given(STAMPS, st.integers(-(2**62), 2**62))
def test_B7_neighbours_by_time_whatever_the_order_of_asking(stamps: list[int], at: int) -> None:
    symbols = PoseSymbols()
    for stamp in stamps:
        symbols.pose_at("m", stamp)

    before, after = symbols.previous("m", at), symbols.next("m", at)

    assert (None if before is None else symbols.place_of(before)[1]) == max(
        (s for s in stamps if s < at), default=None
    )
    assert (None if after is None else symbols.place_of(after)[1]) == min(
        (s for s in stamps if s > at), default=None
    )


def test_G2_as_many_poses_as_distinct_stamps_were_asked_for() -> None:
    symbols = PoseSymbols()
    for stamp in [5, 3, 5, 9, 3]:
        symbols.pose_at("a", stamp)
    symbols.pose_at("b", 5)

    assert len(symbols) == 4


def test_a_pose_that_nobody_asked_for_is_an_error() -> None:
    with pytest.raises(EstimationError, match="no pose at 7 ns"):
        PoseSymbols().known("m", 7)
