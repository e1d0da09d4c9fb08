"""Clouds come back as they were, from memory or from disk, and memory stays bounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.cloud_store import CloudStore, cloud_key, read_cloud
from mapstream.streams.errors import MapError, MapFormatError
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.sizes import nbytes


def cloud(num_points: int, seed: int = 0, *, with_intensity: bool = True) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(num_points, 3)).astype(np.float32)
    return PointCloud(
        stamp_ns=seed,
        points=points,
        intensity=points[:, 0] if with_intensity else None,
        colors_rgba=rng.integers(0, 255, (num_points, 4), np.uint8) if seed % 2 else None,
    )


def assert_equal(a: PointCloud, b: PointCloud) -> None:
    assert a.stamp_ns == b.stamp_ns
    assert a.points.tobytes() == b.points.tobytes()
    assert (a.intensity is None) == (b.intensity is None)
    if a.intensity is not None and b.intensity is not None:
        assert a.intensity.tobytes() == b.intensity.tobytes()
    assert (a.colors_rgba is None) == (b.colors_rgba is None)
    if a.colors_rgba is not None and b.colors_rgba is not None:
        assert a.colors_rgba.tobytes() == b.colors_rgba.tobytes()


def test_I8_memory_stays_bounded_while_all_clouds_are_kept(tmp_path: Path) -> None:
    size = nbytes(cloud(100, 1))
    with CloudStore(tmp_path, max_bytes=3 * size) as store:
        for n in range(20):
            store.put(f"c{n}", cloud(100, n))
            assert store.num_bytes <= 3 * size

        assert len(store.keys()) == 20
        for n in range(20):
            assert_equal(store.get(f"c{n}"), cloud(100, n))
            assert store.num_bytes <= 3 * size


def test_what_was_used_last_is_kept_in_memory(tmp_path: Path) -> None:
    with CloudStore(tmp_path, max_bytes=2 * nbytes(cloud(10, 1))) as store:
        first = cloud(10, 1)
        store.put("a", first)
        store.put("b", cloud(10, 3))
        store.get("a")
        store.put("c", cloud(10, 5))

        assert store.get("a") is first
        assert store.get("b") is not None


def test_a_cloud_larger_than_the_bound_is_read_from_disk(tmp_path: Path) -> None:
    with CloudStore(tmp_path, max_bytes=10) as store:
        store.put("large", cloud(1000))

        assert store.num_bytes == 0
        assert_equal(store.get("large"), cloud(1000))


@settings(max_examples=20)
@given(st.integers(0, 50), st.booleans(), st.integers(-(2**63), 2**63 - 1))
def test_a_cloud_survives_its_file(num_points: int, with_intensity: bool, stamp_ns: int) -> None:  # noqa: FBT001
    made = cloud(num_points, 1, with_intensity=with_intensity)
    put = replace(made, stamp_ns=stamp_ns)
    with CloudStore(max_bytes=0) as store:
        store.put("key", put)
        once = store.path_of("key").read_bytes()
        store.put("key", store.get("key"))

        assert_equal(store.get("key"), put)
        assert store.path_of("key").read_bytes() == once


def test_a_temporary_store_leaves_nothing() -> None:
    with CloudStore() as store:
        store.put(cloud_key("ab" * 16, -5), cloud(3))
        folder = store.directory

    assert not folder.exists()


def test_a_store_finds_what_an_earlier_one_left(tmp_path: Path) -> None:
    with CloudStore(tmp_path / "clouds") as store:
        store.put("b", cloud(3, 1))
        store.put("a", cloud(3, 2))

    with CloudStore(tmp_path / "clouds") as store:
        assert store.keys() == ["a", "b"]
        assert "a" in store
        assert "c" not in store
        assert_equal(store.get("a"), cloud(3, 2))


@pytest.mark.parametrize("key", ["", "../up", "a/b", ".hidden", "x" * 200, "a\n"])
def test_keys_that_are_no_file_names_are_refused(key: str, tmp_path: Path) -> None:
    with CloudStore(tmp_path) as store, pytest.raises(ValueError, match="the key of a cloud"):
        store.put(key, cloud(1))


def test_missing_and_damaged_clouds_are_named(tmp_path: Path) -> None:
    with CloudStore(tmp_path) as store:
        store.put("a", cloud(50))
        with pytest.raises(MapError, match=r"b\.arrow: no such cloud"):
            store.get("b")
        whole = store.path_of("a").read_bytes()
        for damaged in (b"", whole[:200], b"\x00" * len(whole)):
            store.path_of("a").write_bytes(damaged)
            with pytest.raises(MapFormatError, match=r"a\.arrow: damaged"):
                read_cloud(store.path_of("a"))
