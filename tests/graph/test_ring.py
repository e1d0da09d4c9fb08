"""Messages cross in shared memory: equal, read-only where they were, and the memory comes back."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mapstream.graph.packing import pack, unpack
from mapstream.graph.ring import RingReader, RingWriter, make_memory
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, Odometry, PointCloud, Submap
from mapstream.streams.messages.sensors import LidarScan

_SIZE = 1 << 20


@pytest.fixture
def ring() -> Iterator[tuple[RingWriter, RingReader]]:
    descriptor = make_memory(_SIZE)
    yield RingWriter(descriptor), RingReader(descriptor)
    os.close(descriptor)


def cross(value: object, ring: tuple[RingWriter, RingReader]) -> Any:  # noqa: ANN401
    return unpack(memoryview(pack(value, ring[0])), ring[1])


def is_shared(array: np.ndarray, ring: tuple[RingWriter, RingReader]) -> bool:
    return np.shares_memory(array, ring[1]._memory)


def test_a_scan_arrives_equal_and_its_arrays_are_views(
    ring: tuple[RingWriter, RingReader],
) -> None:
    scan = LidarScan(
        stamp_ns=7,
        points=np.arange(3000, dtype=np.float32).reshape(1000, 3),
        ring=np.arange(1000, dtype=np.uint16) % 32,
        T_base_sensor=SE3.identity(),
    )

    other = cross(scan, ring)

    assert other.stamp_ns == 7
    np.testing.assert_array_equal(other.points, scan.points)
    np.testing.assert_array_equal(other.ring, scan.ring)
    assert is_shared(other.points, ring)
    assert not other.points.flags.writeable
    assert other.intensity is None


_ARRAYS = hnp.arrays(
    dtype=st.sampled_from(["f8", "f4", "u1", "i8", "?", "u2"]),
    shape=hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=40),
)


@given(array=_ARRAYS, writeable=st.booleans(), layout=st.sampled_from("CFS"))
def test_any_array_arrives_with_dtype_shape_values_and_flag(
    *, array: np.ndarray, writeable: bool, layout: str
) -> None:
    """C and Fortran order, and every second element of a larger array."""
    descriptor = make_memory(_SIZE)
    ring = RingWriter(descriptor), RingReader(descriptor)
    os.close(descriptor)
    if layout == "S" and array.ndim:
        array = np.repeat(array, 2, axis=0)[::2]
    elif layout == "F":
        array = np.asfortranarray(array)
    array.flags.writeable = writeable

    other = cross(array, ring)

    assert other.dtype == array.dtype
    assert other.shape == array.shape
    assert other.tobytes() == array.tobytes()
    assert other.flags.writeable == writeable


def test_memory_comes_back_when_the_last_view_is_gone(ring: tuple[RingWriter, RingReader]) -> None:
    """Many times the size of the memory passes through it, and all of it as views."""
    data = np.zeros(_SIZE // 8 // 4)  # a quarter of the memory

    for number in range(20):
        array = cross(data + number, ring)
        assert is_shared(array, ring)
        part = array[3:5]
        del array
        assert part.tolist() == [number, number]
        del part


def test_a_message_that_is_held_does_not_block_the_others(
    ring: tuple[RingWriter, RingReader],
) -> None:
    data = np.arange(_SIZE // 8 // 8, dtype=np.float64)
    held = [cross(data + i, ring) for i in range(20)]  # more than the memory takes

    assert [array[0] for array in held] == list(range(20))
    assert is_shared(held[0], ring)
    assert not is_shared(held[19], ring)  # a copy: the memory is for what is on its way


def test_nested_messages_and_what_only_pickle_knows_arrive(
    ring: tuple[RingWriter, RingReader],
) -> None:
    cloud = PointCloud(stamp_ns=5, points=np.ones((500, 3), np.float32))
    odometry = Odometry(stamp_ns=5, T_odom_base=SE3.identity(), is_lost=True)
    keyframe = Keyframe(stamp_ns=5, odometry=odometry, cloud=cloud)
    table = np.zeros(300, dtype=[("a", "f8"), ("b", "i4")])
    submap = Submap(mission_id="0" * 32, index=3, keyframes=(keyframe, keyframe), edges=())

    other, found, names = cross((submap, table, {"x": [1, (2, 3)]}), ring)

    assert other.keyframes[1].odometry.is_lost
    assert other.keyframes[1].odometry.T_odom_base.matrix.tolist() == np.eye(4).tolist()
    np.testing.assert_array_equal(other.keyframes[1].cloud.points, cloud.points)
    assert is_shared(other.keyframes[1].cloud.points, ring)
    assert found.dtype == table.dtype
    assert names == {"x": [1, (2, 3)]}


def test_what_is_larger_than_the_memory_goes_through_the_pipe(
    ring: tuple[RingWriter, RingReader],
) -> None:
    data = np.arange(_SIZE // 4, dtype=np.float64)
    data.flags.writeable = False

    other = cross(data, ring)

    np.testing.assert_array_equal(other, data)
    assert not other.flags.writeable


def test_many_small_messages_reuse_the_places(ring: tuple[RingWriter, RingReader]) -> None:
    for _ in range(1000):
        assert is_shared(cross(np.zeros(400), ring), ring)
    gc.collect()
    assert not ring[1]._held


def test_the_reader_leaves_word_of_what_it_took(ring: tuple[RingWriter, RingReader]) -> None:
    writer, reader = ring
    assert writer.noted(3) is None

    reader.note(3, -5)

    assert writer.noted(3) == -5
    assert writer.noted(2) is None
