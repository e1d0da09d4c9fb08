"""Indices of descriptors against brute force. A million descriptors: `benchmarks/places.py`."""

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.places.indices.index import (
    DescriptorIndex,
    Descriptors,
    IndexConfig,
    load_index,
    make_index,
    save_index,
)
from mapstream.recordings.maps.projections import DescriptorProjection
from mapstream.streams.errors import MapError
from tests.operators.places import descriptors as made

_SMALL = IndexConfig(exact_up_to=600)
_CONFIGS = {
    "multi_index": _SMALL,
    "hnsw": IndexConfig(numbers="hnsw"),
    "flann": IndexConfig(numbers="flann"),
    "exact bits": IndexConfig(binary="exact"),
    "exact numbers": IndexConfig(numbers="exact"),
}
_BINARY = ("multi_index", "exact bits")


def _descriptors(kind: str, count: int) -> tuple[Descriptors, Descriptors]:
    """Some descriptors, and some of them seen again."""
    if kind in _BINARY:
        stored: Descriptors = made.binary(count, seed=1)
        return stored, made.with_flipped_bits(stored[::7], 0.1, seed=2)
    stored = made.numbers(count, seed=1)
    return stored, made.with_noise(stored[::7], 0.05, seed=2)


def _index(kind: str, stored: Descriptors, *, batch: int) -> DescriptorIndex:
    index = make_index(stored.shape[1], stored.dtype, _CONFIGS[kind])
    for start in range(0, len(stored), batch):
        index.add(stored[start : start + batch])
    return index


@pytest.mark.parametrize("kind", list(_CONFIGS))
def test_H2_H3_an_index_that_grew_finds_what_brute_force_finds(kind: str) -> None:
    stored, queries = _descriptors(kind, 3000)
    exact = make_index(stored.shape[1], stored.dtype, IndexConfig(binary="exact", numbers="exact"))
    exact.add(stored)

    found = _index(kind, stored, batch=250).search(queries, 3)

    truth = exact.search(queries, 3)
    is_found = found.rows[:, 0] == truth.rows[:, 0]
    assert is_found.mean() >= 0.95
    assert found.distances[is_found, 0] == pytest.approx(truth.distances[is_found, 0], abs=1e-3)
    assert (np.diff(found.distances, axis=1) >= 0).all()


@pytest.mark.parametrize("kind", list(_CONFIGS))
def test_H2_H3_an_index_comes_back_from_its_file(kind: str, tmp_path: Path) -> None:
    stored, queries = _descriptors(kind, 1000)
    index = _index(kind, stored, batch=400)

    save_index(index, tmp_path / "index.npz")
    again = load_index(
        make_index(stored.shape[1], stored.dtype, _CONFIGS[kind]), tmp_path / "index.npz"
    )

    assert len(again) == len(index) == 1000
    assert np.mean(again.search(queries, 1).rows == index.search(queries, 1).rows) > 0.98


@pytest.mark.parametrize("kind", list(_CONFIGS))
def test_an_index_with_fewer_descriptors_than_asked_for_says_so(kind: str) -> None:
    stored, _ = _descriptors(kind, 2)

    found = _index(kind, stored, batch=2).search(stored, 3)

    assert found.rows[:, 0].tolist() == [0, 1]
    assert found.rows[:, 2].tolist() == [-1, -1]
    assert np.isinf(found.distances[:, 2]).all()


def test_the_multi_index_takes_a_given_projection() -> None:
    stored, queries = _descriptors("multi_index", 3000)
    matrix = np.random.default_rng(0).standard_normal((512, 10)).astype(np.float32)
    projection = DescriptorProjection("brisk", "index", np.full(512, 0.5, np.float32), matrix)
    index = make_index(64, "uint8", _SMALL, projection)
    index.add(stored)

    found = index.search(queries, 1)

    assert np.mean(found.rows[:, 0] == np.arange(0, 3000, 7)) > 0.95


def test_a_projection_of_other_descriptors_is_refused() -> None:
    other = DescriptorProjection(
        "orb", "index", np.zeros(256, np.float32), np.zeros((256, 10), np.float32)
    )

    with pytest.raises(MapError, match="of orb projects 256 bits, and descriptors have 512"):
        make_index(64, "uint8", _SMALL, other)


def test_descriptors_of_another_type_are_refused() -> None:
    with pytest.raises(MapError, match="not int16"):
        make_index(64, "int16", _SMALL)


@pytest.mark.parametrize("kind", list(_CONFIGS))
def test_a_file_of_something_else_is_refused(kind: str, tmp_path: Path) -> None:
    stored, _ = _descriptors(kind, 1)
    (tmp_path / "index.npz").write_bytes(b"no zip")
    empty = make_index(stored.shape[1], stored.dtype, _CONFIGS[kind])

    with pytest.raises(MapError, match=r"index\.npz: not an index"):
        load_index(empty, tmp_path / "index.npz")


@pytest.mark.parametrize(
    ("size", "neighbours"), [(100, 1), (20_000, 2), (200_000, 3), (2_000_000, 6), (20_000_000, 8)]
)
def test_how_many_neighbours_depends_on_the_size(size: int, neighbours: int) -> None:
    assert IndexConfig().neighbours_among(size) == neighbours
    assert IndexConfig(neighbours=5).neighbours_among(size) == 5
