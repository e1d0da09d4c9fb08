"""Clocks, without real time: a test clock stands in for the monotonic one."""

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import count

import anyio
import anyio.lowlevel
import pytest

from mapstream.streams.channel import Channel, Limits, Receiver
from mapstream.streams.clock import AutoRate, Clock, ReplayClock, TestClock, WallClock
from tests.streams.scripts import Tick

pytestmark = pytest.mark.anyio
SECOND = 1_000_000_000


@dataclass
class Source:
    """Plays messages of a tenth of a second each, as a reader of recordings does."""

    clock: ReplayClock
    real: TestClock
    num_messages: int = 20
    passed: list[tuple[int, int]] = field(default_factory=list)  # stamp and real time [0.1 s]

    async def run(self) -> None:
        at = 0
        while at < self.num_messages:
            await self.clock.sleep_until(100 * SECOND + at * SECOND // 10)
            target_ns = self.clock.take_seek()
            if target_ns is not None:
                at = (target_ns - 100 * SECOND) * 10 // SECOND
                continue
            self.passed.append((at, round(self.real.now_ns() * 10 / SECOND)))
            at += 1

    @property
    def numbers(self) -> list[int]:
        return [number for number, _ in self.passed]


async def _settle() -> None:
    """Let all other tasks run until they wait."""
    for _ in range(10):
        await anyio.lowlevel.checkpoint()


@asynccontextmanager
async def playing(
    rate: float | None = 1.0, auto: AutoRate | None = None
) -> AsyncIterator[tuple[Source, Callable[[float], Awaitable[None]]]]:
    """Give a source that plays, and a function that lets real seconds pass."""
    real = TestClock()
    clock = ReplayClock(rate, auto=auto, monotonic_ns=real.now_ns, sleep=real.sleep)
    source = Source(clock, real)

    async def elapse(seconds: float) -> None:
        end_ns = real.now_ns() + round(seconds * SECOND)
        await _settle()
        while (deadline_ns := real.next_deadline_ns) is not None and deadline_ns <= end_ns:
            real.advance_to(max(deadline_ns, real.now_ns()))
            await _settle()
        real.advance_to(end_ns)
        await _settle()

    with anyio.fail_after(10):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(source.run)
            yield source, elapse
            tasks.cancel_scope.cancel()


@pytest.mark.parametrize(("rate", "per_message"), [(1.0, 1), (0.5, 2), (0.25, 4)])
async def test_B2_B12_deadlines_follow_the_rate(rate: float, per_message: int) -> None:
    async with playing(rate) as (source, elapse):
        await elapse(1.0)

        assert source.passed == [(i, i * per_message) for i in range(10 // per_message + 1)]
        assert source.clock.now_ns() == 100 * SECOND + round(SECOND * rate)
        assert source.clock.achieved_rate == pytest.approx(rate)


async def test_B2_as_fast_as_possible_needs_no_time() -> None:
    async with playing(None) as (source, elapse):
        await elapse(0.0)

        assert source.numbers == list(range(20))
        assert source.clock.now_ns() == 100 * SECOND + 19 * SECOND // 10


async def test_B12_deadlines_are_absolute_so_that_delays_do_not_add_up() -> None:
    async with playing() as (source, elapse):
        await elapse(0.1)
        source.real.advance_to(round(0.55 * SECOND))  # the machine was busy
        await elapse(0.45)

        assert source.passed == [(0, 0), (1, 1)] + [(i, max(i, 6)) for i in range(2, 11)]


async def test_B3_pause_freezes_the_input_and_the_clock() -> None:
    async with playing() as (source, elapse):
        await elapse(0.45)
        source.clock.pause()
        await elapse(5.0)
        frozen = source.numbers, source.clock.now_ns()
        source.clock.resume()
        await elapse(0.55)

        assert frozen == ([0, 1, 2, 3, 4], 100 * SECOND + 45 * SECOND // 100)
        assert source.passed[5:] == [(i, i + 50) for i in range(5, 11)]
        assert source.clock.achieved_rate == pytest.approx(1.0)


async def test_B13_step_lets_one_message_pass() -> None:
    async with playing() as (source, elapse):
        await elapse(0.25)
        for _ in range(3):
            source.clock.step()
            await elapse(2.0)
        assert source.numbers == [0, 1, 2, 3, 4, 5]
        assert source.clock.now_ns() == 100 * SECOND + SECOND // 2

        source.clock.resume()
        await elapse(0.1)
        assert source.numbers == [0, 1, 2, 3, 4, 5, 6]


async def test_B13_step_before_the_first_message() -> None:
    async with playing() as (source, elapse):
        source.clock.step()
        await elapse(1.0)

        assert source.numbers == [0]


async def test_B13_a_step_belongs_to_the_earliest_deadline() -> None:
    clock = ReplayClock()
    passed = []
    clock.pause()

    async def wait(stamp_ns: int) -> None:
        await clock.sleep_until(stamp_ns)
        passed.append(stamp_ns)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(wait, 7)
        tasks.start_soon(wait, 5)
        await _settle()
        clock.step()
        await _settle()
        assert passed == [5]
        clock.step()
    assert passed == [5, 7]


async def test_B13_seek_ends_the_wait_and_starts_time_anew() -> None:
    async with playing() as (source, elapse):
        await elapse(0.25)
        source.clock.seek(100 * SECOND + SECOND)
        await elapse(0.1)
        assert source.numbers == [0, 1, 2, 10, 11]

        source.clock.pause()
        source.clock.seek(100 * SECOND)
        await elapse(1.0)
        assert source.numbers == [0, 1, 2, 10, 11]  # still paused
        source.clock.resume()
        await elapse(0.1)
        assert source.numbers == [0, 1, 2, 10, 11, 0, 1]


async def test_B13_a_section_loops_until_told_otherwise() -> None:
    async with playing(10.0) as (source, elapse):
        source.clock.loop(100 * SECOND + SECOND // 2, 100 * SECOND + SECOND // 2 + SECOND // 5)
        await elapse(0.055)
        assert source.numbers[:8] == [5, 6, 7, 5, 6, 7, 5, 6]
        assert set(source.numbers) == {5, 6, 7}

        source.clock.stop_loop()
        await elapse(1.0)
        assert source.numbers[-1] == 19


async def test_B3_a_change_of_rate_goes_on_from_the_present() -> None:
    async with playing() as (source, elapse):
        await elapse(0.5)
        source.clock.set_rate(4.0)
        await elapse(0.1)

        assert source.numbers == list(range(10))


async def test_B12_auto_rate_keeps_queues_short_and_drops_nothing() -> None:
    """A consumer of 25 ms per message takes messages of 10 Hz four times as fast as they were."""
    real = TestClock()
    channel: Channel[Tick] = Channel(limits=Limits(policy="drop_oldest", capacity=8))
    clock = ReplayClock(
        auto=AutoRate(fill=lambda: channel.fill),
        monotonic_ns=real.now_ns,
        sleep=real.sleep,
    )
    received = []

    async def produce() -> None:
        for number in range(400):
            await clock.sleep_until(number * SECOND // 10)
            await channel.put(Tick(number * SECOND // 10, number))
        channel.close()

    async def consume() -> None:
        async for tick in Receiver(channel):
            await real.sleep(0.025)
            received.append(tick.number)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(produce)
        tasks.start_soon(consume)
        while len(received) < 400:
            await _settle()
            if real.next_deadline_ns is not None:
                real.advance_to(real.next_deadline_ns)

    assert received == list(range(400))
    assert channel.stats.high_water < 8
    assert not channel.stats.dropped
    assert 3.6 < clock.achieved_rate <= 4.2


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_B12_a_rate_that_is_not_positive_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        ReplayClock(rate)


def test_B13_a_section_that_ends_before_it_starts_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot end"):
        ReplayClock().loop(5, 4)


async def test_B2_the_test_clock_moves_only_by_hand() -> None:
    clock = TestClock(5)
    passed = []

    async def wait() -> None:
        await clock.sleep_until(10)
        passed.append(clock.now_ns())

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(wait)
        await _settle()
        assert clock.next_deadline_ns == 10
        clock.advance_to(9)
        await _settle()
        assert passed == []
        clock.advance_to(12)
    assert passed == [12]
    with pytest.raises(ValueError, match="cannot go back from 12 to 11"):
        clock.advance_to(11)


async def test_B2_the_wall_clock_does_not_wait_for_the_past() -> None:
    clock: Clock = WallClock()

    await clock.sleep_until(clock.now_ns() - SECOND)


async def test_a_deadline_that_passes_while_one_looks_at_it_is_not_slept_for() -> None:
    """Each look takes a while, so that the time is later than it was when the deadline was still ahead."""
    looks = count(0, 30_000_000)
    slept_s: list[float] = []

    async def sleep(seconds: float) -> None:
        slept_s.append(seconds)
        await anyio.lowlevel.checkpoint()

    clock = ReplayClock(monotonic_ns=lambda: next(looks), sleep=sleep)
    for number in range(20):
        await clock.sleep_until(number * SECOND // 10)

    assert slept_s
    assert min(slept_s) >= 0
