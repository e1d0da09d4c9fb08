"""Joins: the same tuples however messages arrive, in order, without ever hanging."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import anyio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.streams.channel import Channel, Limits, Receiver
from mapstream.streams.messages.sensors import ImuBatch, LidarScan
from mapstream.streams.sync import (
    Join,
    anchored,
    approximate,
    cut_imu,
    exact,
    interpolate,
    latest,
    merge,
    nearest,
    window,
)
from tests.streams.scripts import MAX_LATENESS_NS, Advance, Script, Tick, play, scripts, ticks

TURNS = st.lists(st.integers(0, 5), max_size=60)


def _blend(before: Tick, after: Tick, stamp_ns: int) -> tuple[int, int, int]:
    return before.number, after.number, stamp_ns


JOINS: dict[str, Callable[..., Join[Any]]] = {
    "merge": merge,
    "exact": exact,
    "approximate": lambda *r: approximate(*r, within_ns=7),
    "nearest": lambda a, b, c: anchored(a, nearest(b, 6), nearest(c, 9, optional=True)),
    "latest": lambda a, b, c: anchored(a, latest(b), latest(c, optional=True)),
    "interpolate": lambda a, b, c: anchored(
        a, interpolate(b, 9, _blend), interpolate(c, 4, _blend, optional=True)
    ),
    "window": lambda a, b, c: anchored(
        a, window(b, 6, 3, patience_ns=10), window(c, 4, 9, cover=False)
    ),
    "interval": lambda a, b, c: anchored(
        a,
        window(b, cover=False),
        window(c, 2, 2, optional=True),
        interval=lambda m: (m.stamp_ns - 3, m.stamp_ns + 11),
    ),
}


def _kept(script: Script) -> list[Tick]:
    """Return the messages of a port that are not behind its bound."""
    bound_ns, kept = -(2**63), []
    for step in script:
        if isinstance(step, Advance):
            bound_ns = max(bound_ns, step.bound_ns)
        elif step.stamp_ns >= bound_ns:
            kept.append(step)
            bound_ns = max(bound_ns, step.stamp_ns - MAX_LATENESS_NS)
    return sorted(kept, key=lambda tick: tick.stamp_ns)


@pytest.mark.parametrize("name", JOINS)
@given(port_scripts=st.tuples(scripts(), scripts(), scripts()), turns=TURNS)
def test_any_interleaving_gives_the_same_tuples_and_counts(
    name: str, port_scripts: tuple[Script, ...], turns: list[int]
) -> None:
    joins: list[Join[Any]] = []

    def remembered(*receivers: Receiver[Tick]) -> Join[Any]:
        joins.append(JOINS[name](*receivers))
        return joins[-1]

    async def play_twice() -> list[list[Any]]:
        with anyio.fail_after(10):
            return [await play(remembered, port_scripts, order) for order in (turns, [])]

    one, other = anyio.run(play_twice)

    assert one == other
    for join in joins:
        join.stats.nearest_miss_ns.clear()  # tells what was seen until the decision
    assert joins[0].stats == joins[1].stats


@given(port_scripts=st.lists(scripts(), min_size=1, max_size=4), turns=TURNS)
def test_merge_sorts_by_stamp_and_port(port_scripts: list[Script], turns: list[int]) -> None:
    expected = sorted(
        ((i, tick) for i, script in enumerate(port_scripts) for tick in _kept(script)),
        key=lambda found: (found[1].stamp_ns, found[0]),
    )

    assert anyio.run(play, merge, port_scripts, turns) == expected


def _queued(*stamps_ns: int, name: str = "", spans_epochs: bool = False) -> Receiver[Tick]:
    """Return a receiver with messages in its queue, and the end."""
    channel: Channel[Tick] = Channel(name, Limits(capacity=1000))
    for tick in ticks(*stamps_ns):
        assert isinstance(tick, Tick)
        assert channel.offer(tick)
    channel.close()
    return Receiver(channel, spans_epochs=spans_epochs)


async def _stamps(join: Join[Any]) -> list[tuple[Any, ...]]:
    """Return the stamps of what a join yields; of windows tuples of stamps."""

    def stamp(item: Any) -> Any:  # noqa: ANN401  # whatever a take gives
        return (
            tuple(map(stamp, item)) if isinstance(item, tuple) else getattr(item, "stamp_ns", item)
        )

    return [stamp(found) async for found in join]


@pytest.mark.anyio
async def test_merge_waits_for_a_delayed_port_no_longer_than_the_delay() -> None:
    late: Channel[Tick] = Channel("late", Limits())
    late.advance(4)  # nothing older follows, and nothing is there yet
    join = merge(_queued(1, 5, 9, 13), Receiver(late), delays_ns=(0, 6))
    stream = aiter(join)

    soon = [(await anext(stream))[1].stamp_ns for _ in range(3)]
    with anyio.move_on_after(0.01) as waiting:
        await anext(stream)

    assert soon == [1, 5, 9]
    assert waiting.cancelled_caught  # 13 may come after a message of 4 to 6


@pytest.mark.anyio
async def test_merge_orders_by_stamps_and_delays() -> None:
    join = merge(_queued(1, 5, 9, 13), _queued(0, 4, 8), delays_ns=(0, 6))

    found = [(port, tick.stamp_ns) async for port, tick in join]

    assert found == [(0, 1), (0, 5), (1, 0), (0, 9), (1, 4), (0, 13), (1, 8)]


@pytest.mark.anyio
async def test_exact_pairs_equal_stamps_and_counts_the_rest() -> None:
    join = exact(_queued(1, 2, 3, 5, name="left"), _queued(2, 3, 4, 5, 5, name="right"))

    assert await _stamps(join) == [(2, 2), (3, 3), (5, 5)]
    assert join.stats.unmatched == {
        ("left", "no right at its stamp"): 1,
        ("right", "no left at its stamp"): 2,
    }
    assert join.explain() == (
        "left, right: 3 matched; 1 of left not: no right at its stamp; "
        "2 of right not: no left at its stamp"
    )


@given(
    first=st.lists(st.integers(0, 60), max_size=8), second=st.lists(st.integers(0, 60), max_size=8)
)
def test_approximate_sets_are_narrow_ordered_and_use_each_message_once(
    first: list[int], second: list[int]
) -> None:
    join = approximate(_queued(*sorted(first)), _queued(*sorted(second)), within_ns=6)

    found = anyio.run(_stamps, join)

    assert all(abs(a - b) <= 6 for a, b in found)
    for port, stamps_ns in enumerate((first, second)):
        used = [pair[port] for pair in found]
        assert used == sorted(used)
        assert not Counter(used) - Counter(stamps_ns)
    for a in first:  # a pair that nothing else could disturb is never missed
        others = [b for b in (*first, *second) if abs(a - b) <= 20]
        if len(others) == 2 and any(abs(a - b) <= 6 for b in second):
            assert a in [pair[0] for pair in found]


@pytest.mark.anyio
async def test_approximate_takes_the_narrowest_set() -> None:
    join = approximate(_queued(0, 100, 200), _queued(8, 99, 205), _queued(2, 101), within_ns=50)

    assert await _stamps(join) == [(0, 8, 2), (100, 99, 101)]


@pytest.mark.anyio
async def test_B9_stamps_within_half_a_millisecond_are_grouped_and_others_counted() -> None:
    ms = 1_000_000
    left = _queued(0, 50 * ms, 100 * ms, 150 * ms, name="left")
    right = _queued(400_000, 50 * ms - 300_000, 107 * ms, 150 * ms + 500_000, name="right")
    join = approximate(left, right, within_ns=500_000)

    found = await _stamps(join)

    assert [a for a, _ in found] == [0, 50 * ms, 150 * ms]
    assert sum(join.stats.unmatched.values()) == 2
    assert "1 of right not: no left within 0.5 ms (the closest was 7.000 ms off)" in join.explain()


@given(
    anchors=st.lists(st.integers(0, 80), max_size=8),
    others=st.lists(st.integers(0, 80), max_size=8),
)
def test_nearest_latest_and_interpolate_agree_with_their_definitions(
    anchors: list[int], others: list[int]
) -> None:
    anchors, others = sorted(anchors), sorted(others)

    def taken(take: Callable[[Receiver[Tick]], Any]) -> dict[int, Any]:
        join = anchored(_queued(*anchors), take(_queued(*others)))
        return dict(anyio.run(_stamps, join))

    near = taken(lambda receiver: nearest(receiver, 7))
    last = taken(latest)
    blended = taken(lambda r: interpolate(r, 7, lambda a, b, _: a.stamp_ns + 1000 * b.stamp_ns))

    for t in anchors:
        close = [s for s in others if abs(s - t) <= 7]
        before, after = [s for s in others if s <= t], [s for s in others if s >= t]
        assert near.get(t) == min(close, key=lambda s: (abs(s - t), s), default=None)
        assert last.get(t) == max(before, default=None)
        expected = None
        if before and after and t - before[-1] <= 7 and after[0] - t <= 7:
            expected = before[-1] + 1000 * after[0]
        assert blended.get(t) == expected


@pytest.mark.anyio
async def test_a_window_that_covers_has_a_neighbour_on_either_side() -> None:
    imu = _queued(*range(2, 60, 5), name="imu")
    join = anchored(_queued(1, 20, 40, 58, name="scans"), window(imu, 5, 5))

    assert await _stamps(join) == [
        (20, (12, 17, 22, 27)),
        (40, (32, 37, 42, 47)),
    ]
    assert join.stats.unmatched == {
        ("scans", "imu begins after the window"): 1,
        ("scans", "imu does not reach the window's end"): 1,
    }


@pytest.mark.anyio
async def test_anchors_of_one_moment_have_the_same_window() -> None:
    """Two cameras that take their images together: the second loses neither of what belongs to them."""
    images = _queued(10, 10, 20, 20, name="images")
    join = anchored(_queued(10, 10, 20, name="objects"), window(images, cover=False))

    assert await _stamps(join) == [(10, (10, 10)), (10, (10, 10)), (20, (20, 20))]


@pytest.mark.anyio
async def test_a_window_over_a_gap_is_refused_as_soon_as_the_bound_tells() -> None:
    second = 1_000_000_000
    scans: Channel[Tick] = Channel("scans")
    imu: Channel[Tick] = Channel("imu")
    join = anchored(Receiver(scans), window(Receiver(imu), optional=True))
    await imu.put(Tick(0))
    await scans.put(Tick(second))
    scans.advance(10 * second)
    imu.advance(2 * second + 1)  # nothing came for longer than the patience of 1 s

    with anyio.fail_after(5):
        assert (await anext(aiter(join)))[1] is None
    assert join.stats.absent == {"imu": 1}


@pytest.mark.anyio
async def test_a_window_around_a_scan_reaches_its_last_point_and_cuts_batches() -> None:
    scans: Channel[LidarScan] = Channel("scans")
    await scans.put(
        LidarScan(stamp_ns=100, points=np.zeros((2, 3), np.float32), offsets_ns=np.array([-5, 95]))
    )
    scans.close()
    imu: Channel[ImuBatch] = Channel("imu", Limits(capacity=100))
    for start in range(0, 400, 50):
        stamps = np.arange(start, start + 50, 10)
        await imu.put(
            ImuBatch(
                stamps_ns=stamps,
                gyro_radps=np.zeros((5, 3)),
                accel_mps2=np.tile(stamps.astype(np.float64), (3, 1)).T,
            )
        )
    imu.close()
    join = anchored(Receiver(scans), window(Receiver(imu), 2, 1, cut=cut_imu))

    ((_, batches),) = [found async for found in join]

    stamps = np.concatenate([batch.stamps_ns for batch in batches])
    np.testing.assert_array_equal(stamps, np.arange(90, 201, 10))  # 93 to 196, and a neighbour each
    np.testing.assert_array_equal(np.concatenate([b.accel_mps2 for b in batches])[:, 2], stamps)


@pytest.mark.anyio
async def test_an_unconnected_optional_port_gives_none() -> None:
    unconnected: Receiver[Tick] | None = None

    assert await _stamps(anchored(_queued(1), window(unconnected, optional=True))) == [(1, None)]


def test_an_unconnected_port_must_be_optional() -> None:
    with pytest.raises(ValueError, match="optional=True"):
        nearest(None, 5)  # type: ignore[call-overload]  # what mypy refuses, the run refuses too


@pytest.mark.anyio
async def test_epochs_never_mix_where_a_join_spans_them() -> None:
    channels = [Channel[Tick](f"p{i}", Limits(capacity=100)) for i in range(2)]
    for stamps_ns in ([1, 2, 3], [2, 3]):
        for channel, kept in zip(channels, (stamps_ns, stamps_ns[:-1]), strict=True):
            for stamp_ns in kept:
                await channel.put(Tick(stamp_ns))
            channel.start_epoch()
    for channel in channels:
        channel.close()
    join = exact(*(Receiver(channel, spans_epochs=True) for channel in channels))

    assert await _stamps(join) == [(1, 1), (2, 2), (2, 2)]
    assert join.ports[0].receiver.epoch == 2


@pytest.mark.anyio
async def test_an_anchored_join_leaves_the_rest_of_an_epoch_behind() -> None:
    channels = [Channel[Tick](f"p{i}", Limits(capacity=100)) for i in range(2)]
    anchors, others = channels
    for stamps_ns in ((5, 6), (1, 2)):
        for stamp_ns in stamps_ns:
            await anchors.put(Tick(stamp_ns))
        for stamp_ns in (*stamps_ns, 90, 91):  # more than the anchors need
            await others.put(Tick(stamp_ns))
        for channel in channels:
            channel.start_epoch()
    anchors.close()
    await others.put(Tick(3))  # and no end: the join does not wait for it

    a, b = (Receiver(channel, spans_epochs=True) for channel in channels)
    with anyio.fail_after(5):
        assert await _stamps(anchored(a, latest(b))) == [(5, 5), (6, 6), (1, 1), (2, 2)]


@pytest.mark.anyio
async def test_a_join_ends_with_the_epoch_where_the_operator_does_not_span_them() -> None:
    channel: Channel[Tick] = Channel()
    await channel.put(Tick(5))
    channel.start_epoch()
    await channel.put(Tick(1))
    receiver = Receiver(channel)

    assert await _stamps(merge(receiver)) == [(0, 5)]
    assert await receiver.enter_next_epoch()
    assert receiver.peek() == Tick(1)


@pytest.mark.anyio
async def test_a_port_that_ended_stops_holding_the_others_back() -> None:
    live: Channel[Tick] = Channel("live")
    join = merge(_queued(1, name="ended"), Receiver(live))
    await live.put(Tick(7))

    with anyio.fail_after(5):
        assert [await anext(aiter(join)) for _ in range(2)] == [(0, Tick(1)), (1, Tick(7))]


@pytest.mark.anyio
async def test_what_is_behind_the_bound_is_dropped_and_counted() -> None:
    channel: Channel[Tick] = Channel("imu", Limits(lateness_ns=2))
    for stamp_ns in (10, 8, 7, 11):
        await channel.put(Tick(stamp_ns))
    channel.close()
    join = merge(Receiver(channel))

    assert await _stamps(join) == [(0, 8), (0, 10), (0, 11)]
    assert join.stats.late == {"imu": 1}
    assert join.explain() == "imu: 3 matched; 1 of imu came too late"
