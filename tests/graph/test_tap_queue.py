"""What waits to be drawn stays within its memory, and what is lost is what matters least."""

from __future__ import annotations

from itertools import pairwise
from threading import Thread
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapstream.graph.tap_queue import TapQueue
from mapstream.streams.messages.estimates import MapCorrection, PointCloud
from mapstream.streams.sizes import nbytes
from tests.graph import made_messages as made


class Seconds:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def cloud(num_points: int = 1000) -> PointCloud:
    return PointCloud(stamp_ns=0, points=np.zeros((num_points, 3), np.float32))


def taken(queue: TapQueue) -> list[Any]:
    items = []
    while (item := queue.take(0.0)) is not None:
        items.append(item)
    return items


def test_messages_come_out_in_order() -> None:
    queue = TapQueue(10**6)
    poses = [made.odometry(step) for step in range(5)]
    for pose in poses:
        queue.put("odometry", pose)

    assert [item.message for item in taken(queue)] == poses


def test_P2_of_what_comes_often_only_the_newest_waits() -> None:
    clock = Seconds()
    queue = TapQueue(10**9, max_rate_hz=10.0, clock=clock)
    clouds = [cloud() for _ in range(3)]
    for i, each in enumerate(clouds):
        clock.now = float(i)
        queue.put("clouds", each)
        queue.put("odometry", made.odometry(i))

    items = taken(queue)

    assert [item.path for item in items] == ["clouds", "odometry", "odometry", "odometry"]
    assert items[0].message is clouds[-1]
    assert queue.lost["clouds", "newer"] == 2


def test_P2_samples_come_no_faster_than_the_limit() -> None:
    clock = Seconds()
    queue = TapQueue(10**9, max_rate_hz=10.0, clock=clock)
    num_drawn = 0
    for i in range(100):
        clock.now = i / 64  # exact in binary, so that no rounding decides
        queue.put("clouds", cloud())
        num_drawn += len(taken(queue))

    assert 13 <= num_drawn <= 16
    assert queue.lost["clouds", "rate"] == 100 - num_drawn


def test_when_memory_runs_out_samples_go_first_and_poses_stay() -> None:
    queue = TapQueue(50_000, max_rate_hz=1e9)
    for i in range(20):
        queue.put(f"clouds{i}", cloud())
        queue.put("odometry", made.odometry(i))

    items = taken(queue)

    assert sum(item.path == "odometry" for item in items) == 20
    assert sum(queue.lost.values()) == 40 - len(items) > 0


def test_a_full_queue_of_poses_costs_no_more_per_message() -> None:
    """A viewer that stopped hours ago must not slow the run: the oldest pose goes, nothing is sorted."""
    queue = TapQueue(2**20)
    for step in range(5000):
        queue.put("odometry", made.odometry(step % 7))

    items = taken(queue)

    assert items[-1].sequence == 4999
    assert [b.sequence - a.sequence for a, b in pairwise(items)] == [1] * (len(items) - 1)
    assert queue.lost["odometry", "memory"] == 5000 - len(items) > 0


def test_a_correction_replaces_the_one_that_waits() -> None:
    queue = TapQueue(10**6)
    for shift_m in (0.0, 1.0):
        queue.put("corrections", made.correction(shift_m=shift_m))

    (item,) = taken(queue)

    assert isinstance(item.message, MapCorrection)
    assert item.message.T_mission_odom.t[1] == 1.0


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3000), st.booleans()), max_size=60))
def test_memory_is_bounded_whatever_comes(steps: list[tuple[bool, int, bool]]) -> None:
    queue = TapQueue(40_000, max_rate_hz=1e9)
    num_put = num_taken = 0
    for is_cloud, size, is_taken in steps:
        queue.put("a" if size % 2 else "b", cloud(size) if is_cloud else made.odometry(size))
        num_put += 1
        num_taken += is_taken and queue.take(0.0) is not None
    num_taken += len(taken(queue))

    assert queue.high_water_bytes <= 40_000
    assert num_taken + sum(queue.lost.values()) == num_put
    assert queue.num_bytes == 0


def test_a_lossless_queue_waits_and_loses_nothing() -> None:
    queue = TapQueue(4 * nbytes(cloud()), is_lossless=True)
    items: list[Any] = []

    def draw() -> None:
        while not queue.has_ended:
            item = queue.take(0.1)
            if item is not None:
                items.append(item)

    thread = Thread(target=draw)
    thread.start()
    for _ in range(200):
        queue.put("clouds", cloud())
    queue.close()
    thread.join()

    assert len(items) == 200
    assert not queue.lost
    assert queue.high_water_bytes <= 4 * nbytes(cloud())


def test_what_comes_after_the_end_is_counted() -> None:
    queue = TapQueue(10**6)
    queue.put("odometry", made.odometry(0))
    queue.abandon()
    queue.put("odometry", made.odometry(1))

    assert dict(queue.lost) == {("odometry", "not drawn in time"): 1, ("odometry", "closed"): 1}
