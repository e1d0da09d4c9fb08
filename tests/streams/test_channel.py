"""Channels: policies, counters, bounds, epochs, and what reaches whom."""

from typing import Any

import anyio
import anyio.lowlevel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.streams.channel import BEGINNING, Channel, Limits, Policy, Receiver, Sender
from mapstream.streams.errors import ChannelError
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.spool import DiskSpool
from tests.streams.scripts import Tick

pytestmark = pytest.mark.anyio


def _channel(policy: Policy = "block", capacity: int = 2, **limits: Any) -> Channel[Tick]:  # noqa: ANN401
    spool = DiskSpool(10_000) if policy == "spool" else None
    return Channel("edge", Limits(policy=policy, capacity=capacity, **limits), spool)


async def _fill(channel: Channel[Tick], *stamps_ns: int) -> None:
    for stamp_ns in stamps_ns:
        await channel.put(Tick(stamp_ns))


async def _drain(channel: Channel[Tick]) -> list[int]:
    channel.close()
    return [tick.stamp_ns async for tick in Receiver(channel)]


async def _settle() -> None:
    for _ in range(5):
        await anyio.lowlevel.checkpoint()


@pytest.mark.parametrize(
    ("policy", "kept"),
    [
        ("drop_oldest", [4, 5]),
        ("drop_newest", [1, 2]),
        ("latest", [5]),
        ("spool", [1, 2, 3, 4, 5]),
    ],
)
async def test_B11_policies_that_never_wait_keep_what_they_promise(
    policy: Policy, kept: list[int]
) -> None:
    channel = _channel(policy)

    with anyio.fail_after(5):
        await _fill(channel, 1, 2, 3, 4, 5)

    assert await _drain(channel) == kept
    assert channel.stats.sent == 5
    assert channel.stats.received == len(kept)
    assert channel.stats.dropped["full"] == 5 - len(kept)
    assert channel.stats.high_water == min(len(kept), 2)


async def test_B11_block_waits_and_loses_nothing() -> None:
    channel = _channel("block")
    received = []

    async def produce() -> None:
        await _fill(channel, *range(100))
        channel.close()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(produce)
        await _settle()
        assert channel.is_sender_waiting
        assert len(channel) == 2
        received = [tick.stamp_ns async for tick in Receiver(channel)]

    assert received == list(range(100))
    assert not channel.stats.dropped
    assert channel.stats.high_water == 2
    assert channel.stats.blocked_ns > 0


async def test_B11_error_names_the_channel() -> None:
    channel = _channel("error")
    await _fill(channel, 1, 2)

    with pytest.raises(ChannelError, match="edge: full with 2 messages"):
        await channel.put(Tick(3))
    assert channel.stats.dropped["full"] == 1


async def test_B11_a_full_spool_drops_the_newest_and_counts_it() -> None:
    channel: Channel[Tick] = Channel("edge", Limits(policy="spool", capacity=1), DiskSpool(600))
    await _fill(channel, *range(50))

    kept = await _drain(channel)

    assert kept == list(range(len(kept)))
    assert 1 < len(kept) < 50
    assert channel.stats.dropped["full"] == 50 - len(kept)


@given(
    policy=st.sampled_from(["block", "drop_oldest", "drop_newest", "latest", "spool"]),
    capacity=st.integers(1, 4),
    takes=st.lists(st.booleans(), max_size=40),
)
def test_B11_what_is_sent_is_received_or_counted_and_never_out_of_order(
    policy: Policy, capacity: int, takes: list[bool]
) -> None:
    async def run() -> None:
        channel = _channel(policy, capacity)
        receiver, received = Receiver(channel), list[int]()
        for stamp_ns, takes_one in enumerate(takes):
            if policy != "block" or len(channel) < capacity:
                await channel.put(Tick(stamp_ns))
            head = receiver.try_receive() if takes_one else None
            if head is not None:
                received.append(head.stamp_ns)
        received += await _drain(channel)

        assert received == sorted(set(received))
        assert channel.stats.received == len(received)
        assert channel.stats.sent == len(received) + channel.stats.dropped.total()
        assert channel.stats.high_water <= capacity

    anyio.run(run)


async def test_B11_bytes_limit_a_channel_but_never_to_nothing() -> None:
    limits = Limits(policy="drop_oldest", capacity=100, max_bytes=3000)
    channel: Channel[PointCloud] = Channel(limits=limits)
    for i in range(5):
        await channel.put(PointCloud(stamp_ns=i, points=np.zeros((100, 3), np.float32)))
    assert len(channel) == 3
    await channel.put(PointCloud(stamp_ns=9, points=np.zeros((10_000, 3), np.float32)))

    assert channel.stats.dropped["full"] == 3
    channel.close()
    assert [cloud.stamp_ns async for cloud in Receiver(channel)] == [3, 4, 9]


async def test_B11_old_messages_are_dropped_when_they_are_taken() -> None:
    channel = _channel(capacity=9, max_age_ns=0)
    await _fill(channel, 1, 2, 3)

    assert await _drain(channel) == []
    assert channel.stats.dropped == {"age": 3}


async def test_a_channel_holds_at_least_one_message() -> None:
    with pytest.raises(ValueError, match="at least one message, not 0"):
        Limits(capacity=0)


async def test_a_spool_needs_a_place() -> None:
    with pytest.raises(ValueError, match="channel edge: the policy spool needs a place"):
        Channel("edge", Limits(policy="spool"))


async def test_a_message_after_the_end_is_refused() -> None:
    channel = _channel()
    channel.close()

    with pytest.raises(ChannelError, match="edge: a message was sent after the end"):
        await channel.put(Tick(1))


@pytest.mark.parametrize("policy", ["drop_oldest", "drop_newest", "latest"])
async def test_a_drop_still_moves_the_bound(policy: Policy) -> None:
    channel = _channel(policy)
    receiver = Receiver(channel)
    await _fill(channel, 1, 2, 3, 4)

    while receiver.try_receive() is not None:
        pass
    assert receiver.bound_ns == 4


async def test_the_bound_counts_what_is_still_queued() -> None:
    channel = _channel(capacity=9)
    receiver = Receiver(channel)
    assert receiver.bound_ns == BEGINNING

    await _fill(channel, 3, 7)
    channel.advance(20)
    channel.advance(10)  # an older promise takes nothing back

    assert receiver.bound_ns == 3
    assert receiver.try_receive() == Tick(3)
    assert receiver.bound_ns == 7
    assert receiver.try_receive() == Tick(7)
    assert receiver.bound_ns == 20


async def test_lateness_lets_messages_overtake_and_counts_those_behind_it() -> None:
    channel = _channel(capacity=9, lateness_ns=5)
    receiver = Receiver(channel)
    await _fill(channel, 100, 96, 200, 194)

    assert receiver.bound_ns == 95
    assert channel.stats.late == 1
    assert [t.stamp_ns for t in iter(receiver.try_receive, None)] == [100, 96, 200, 194]
    assert receiver.arrival.bound_ns == 195  # the last one was late


async def test_a_bound_never_falls_below_a_promise() -> None:
    channel = _channel(lateness_ns=50)
    channel.advance(100)
    await _fill(channel, 120)

    assert channel.bound_ns == 100


async def test_a_wait_ends_with_a_bound_but_a_plain_read_does_not() -> None:
    channel = _channel()
    woken = []

    async def wait(receiver: Receiver[Tick]) -> None:
        await receiver.wait()
        woken.append("bound")

    async def read(receiver: Receiver[Tick]) -> None:
        woken.append(str((await anext(receiver)).stamp_ns))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(wait, Receiver(channel))
        tasks.start_soon(read, Receiver(channel))
        await _settle()
        assert channel.is_receiver_waiting
        channel.advance(5)
        await _settle()
        assert woken == ["bound"]
        await channel.put(Tick(7))
    assert woken == ["bound", "7"]
    assert not channel.is_receiver_waiting


async def test_a_cancelled_wait_leaves_no_trace() -> None:
    channel = _channel(capacity=1)
    await _fill(channel, 1)
    with anyio.move_on_after(0):
        await channel.put(Tick(2))
    assert not channel.is_sender_waiting

    empty = _channel()
    with anyio.move_on_after(0):
        await anext(Receiver(empty))
    assert not empty.is_receiver_waiting


async def test_an_epoch_ends_the_iteration_of_who_does_not_span_it() -> None:
    channel = _channel(capacity=9)
    receiver = Receiver(channel)
    await _fill(channel, 8, 9)
    channel.start_epoch()
    await _fill(channel, 1, 2, 3)
    channel.close()

    assert [tick.stamp_ns async for tick in receiver] == [8, 9]
    assert receiver.has_ended
    assert await receiver.enter_next_epoch()
    assert receiver.bound_ns == 1
    assert [tick.stamp_ns async for tick in receiver] == [1, 2, 3]
    assert receiver.arrival.epoch == 1
    assert not await receiver.enter_next_epoch()


async def test_what_is_left_of_an_epoch_is_counted_as_unread() -> None:
    channel = _channel(capacity=9)
    await _fill(channel, 8, 9)
    channel.start_epoch()
    await _fill(channel, 1)

    receiver = Receiver(channel)
    assert await receiver.enter_next_epoch()
    assert channel.stats.dropped == {"unread": 2}
    assert receiver.peek() == Tick(1)


async def test_who_spans_epochs_reads_on_and_knows_where_it_is() -> None:
    channel = _channel(capacity=9)
    await _fill(channel, 8)
    channel.start_epoch()
    channel.start_epoch()
    await _fill(channel, 1)
    channel.close()
    receiver = Receiver(channel, spans_epochs=True)

    found = [(tick.stamp_ns, receiver.arrival.epoch) async for tick in receiver]

    assert found == [(8, 0), (1, 2)]


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "latest", "spool"])
async def test_no_policy_loses_the_mark_of_an_epoch(policy: Policy) -> None:
    channel = _channel(policy, 2)
    for _ in range(2):
        await _fill(channel, *(range(2) if policy == "block" else range(5)))
        channel.start_epoch()
        if policy == "block":
            channel.grow(9)
    channel.close()
    receiver = Receiver(channel)

    epochs = [[tick.stamp_ns async for tick in receiver]]
    while await receiver.enter_next_epoch():
        epochs.append([tick.stamp_ns async for tick in receiver])

    assert len(epochs) == 3
    assert epochs[2] == []
    assert epochs[1] == {"block": [0, 1], "drop_oldest": [3, 4], "latest": [4]}.get(
        policy, [0, 1, 2, 3, 4]
    )


async def test_a_spool_keeps_its_order_when_the_channel_grows() -> None:
    channel = _channel("spool", 1)
    await _fill(channel, 1, 2, 3)
    channel.grow(2)
    await _fill(channel, 4)

    assert await _drain(channel) == [1, 2, 3, 4]


@pytest.mark.parametrize("policy", ["block", "spool"])
async def test_an_abandoned_channel_takes_everything_and_counts_it_as_unread(
    policy: Policy,
) -> None:
    channel = _channel(policy)
    if policy == "spool":
        await _fill(channel, 1, 2, 3)
        channel.start_epoch()

    async with anyio.create_task_group() as tasks:
        if policy == "block":
            tasks.start_soon(_fill, channel, 1, 2, 3)
            await _settle()
        Receiver(channel).close()

    await _fill(channel, 4)
    assert channel.stats.dropped == {"unread": 4}
    assert len(channel) == 0


async def test_growing_frees_a_sender() -> None:
    channel = _channel(capacity=1)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_fill, channel, 1, 2, 3)
        await _settle()
        channel.grow(3)

    assert len(channel) == 3
    assert channel.stats.grown == 1


async def test_a_sender_reaches_every_channel_and_waits_for_the_slow_one() -> None:
    slow, fast = _channel(capacity=1), _channel(capacity=9)
    sender = Sender([slow, fast])

    async def produce() -> None:
        for stamp_ns in range(5):
            await sender.send(Tick(stamp_ns))
        sender.advance(9)
        sender.start_epoch()
        sender.close()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(produce)
        await _settle()
        assert len(fast) == 1  # the second message waits at the slow channel first
        assert [t.stamp_ns async for t in Receiver(slow)] == list(range(5))
    assert [t.stamp_ns async for t in Receiver(fast)] == list(range(5))


async def test_a_slow_channel_that_drops_does_not_delay_the_others() -> None:
    slow, fast = _channel("latest"), _channel(capacity=100)
    sender = Sender([slow, fast])
    with anyio.fail_after(5):
        for stamp_ns in range(100):
            await sender.send(Tick(stamp_ns))

    assert await _drain(fast) == list(range(100))
    assert await _drain(slow) == [99]


async def test_arrival_tells_sequence_and_stamp() -> None:
    channel = _channel(capacity=9)
    receiver, found = Receiver(channel), list[tuple[int, int | None]]()
    assert receiver.last_stamp_ns is None
    await _fill(channel, 5, 6)
    channel.close()

    async for _ in receiver:
        found.append((receiver.arrival.sequence, receiver.last_stamp_ns))

    assert found == [(0, 5), (1, 6)]


async def test_spooled_messages_come_back_as_they_were(tmp_path: Any) -> None:  # noqa: ANN401
    spool = DiskSpool(1_000_000, tmp_path)
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    for i in range(3):
        assert spool.put((PointCloud(stamp_ns=i, points=points + i), i, 0, i, i))
    assert list(tmp_path.iterdir()) == []  # nobody else can see it

    for i in range(3):
        cloud, *rest = spool.get()
        assert rest == [i, 0, i, i]
        np.testing.assert_array_equal(cloud.points, points + i)
        assert not cloud.points.flags.writeable
    assert len(spool) == 0
    with pytest.raises(IndexError, match="empty"):
        spool.get()


async def test_a_spool_uses_its_space_again() -> None:
    spool = DiskSpool(300)
    entry = (Tick(1), 0, 0, 1, 1)

    for _ in range(100):
        assert spool.put(entry)
        assert spool.get() == entry
