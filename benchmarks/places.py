"""Indices of descriptors: a million of them, against comparing with each, in one run on one core.

Queries are descriptors of the index seen again: a tenth of the bits flipped, or noise on the numbers.
"""

from __future__ import annotations

import os
import time

import numpy as np

from benchmarks.table import Row, markdown
from mapstream.operators.places.indices.index import (
    DescriptorIndex,
    Descriptors,
    IndexConfig,
    make_index,
)
from tests.operators.places import descriptors as made

NUM_DESCRIPTORS, BLOCK = 1_000_000, 50_000
NUM_QUERIES = 500
EXACT = IndexConfig(binary="exact", numbers="exact")


def _filled(descriptors: Descriptors, config: IndexConfig) -> tuple[DescriptorIndex, float]:
    """Return an index with all descriptors, and the seconds that adding them took."""
    index = make_index(descriptors.shape[1], descriptors.dtype, config)
    started_s = time.perf_counter()
    for start in range(0, len(descriptors), BLOCK):
        index.add(descriptors[start : start + BLOCK])
    return index, time.perf_counter() - started_s


def _rows(
    name: str, stored: Descriptors, queries: Descriptors, configs: dict[str, IndexConfig]
) -> list[Row]:
    exact, _ = _filled(stored, EXACT)
    started_s = time.perf_counter()
    truth = exact.search(queries, 1).rows[:, 0]
    exact_s = time.perf_counter() - started_s
    rows = []
    for kind, config in configs.items():
        index, added_s = _filled(stored, config)
        started_s = time.perf_counter()
        found = index.search(queries, 1).rows[:, 0]
        search_s = time.perf_counter() - started_s
        recall = float(np.mean(found == truth))
        bar = "at least 20, recall 0.90" if name == "bits" else "recall 0.95"
        rows.append(
            Row(
                what=f"{kind}, {len(stored):.0e} descriptors of {name}",
                ours=f"recall {recall:.3f}, {1e6 * search_s / len(queries):.0f} us a query,"
                f" {added_s:.0f} s to add",
                other=f"exact search {1e6 * exact_s / len(queries):.0f} us",
                ratio=exact_s / search_s,
                bar=bar,
            )
        )
    return rows


def run() -> list[Row]:
    """Return the rows of the table; PLACES_DESCRIPTORS says how many there are."""
    count = int(os.environ.get("PLACES_DESCRIPTORS", NUM_DESCRIPTORS))
    chosen = np.random.default_rng(5).integers(0, count, NUM_QUERIES)
    bits = np.concatenate([made.binary(BLOCK, seed) for seed in range(max(count // BLOCK, 1))])
    seen_again = made.with_flipped_bits(bits[chosen % len(bits)], 0.1, seed=6)
    rows = _rows("bits", bits, seen_again, {"inverted multi-index": IndexConfig()})
    numbers = np.concatenate([made.numbers(BLOCK, seed) for seed in range(max(count // BLOCK, 1))])
    seen_again_numbers = made.with_noise(numbers[chosen % len(numbers)], 0.05, seed=6)
    flann = {"FLANN": IndexConfig(numbers="flann")}
    rows += _rows("32 numbers", numbers, seen_again_numbers, flann)
    few = numbers[: count // 5]  # HNSW takes minutes to add a million
    seen_again_few = made.with_noise(few[chosen % len(few)], 0.05, seed=6)
    hnsw = {"HNSW": IndexConfig(numbers="hnsw")}
    return rows + _rows("32 numbers", few, seen_again_few, hnsw)


if __name__ == "__main__":
    print(markdown(run()))
