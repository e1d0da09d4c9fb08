"""Projections of descriptors are learnt from a map, stay with it, and lose little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapstream.operators.features.compress_descriptors import (
    CompressDescriptors,
    CompressDescriptorsConfig,
    compressed,
)
from mapstream.operators.features.detectors import Detected, DetectorOptions, make_detector
from mapstream.operators.maps.descriptor_projections import (
    CompressConfig,
    TrainProjectionConfig,
    compress_descriptors,
    principal_components,
    separating,
    train_projection,
)
from mapstream.operators.maps.merge import merge
from mapstream.operators.places.indices.projection import learn_projection
from mapstream.operators.places.loops import find_visual_loops
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.descriptor_matching import MatchRules, matched
from mapstream.recordings.maps import Map, check_map, load_map, save_map
from mapstream.recordings.maps.combine import merge_maps, select_missions
from mapstream.recordings.maps.features import descriptors_of
from mapstream.recordings.maps.projections import as_numbers, projections_of, with_projection
from mapstream.streams.errors import ConfigError, MapError
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.places import descriptors as made
from tests.operators.places import made_maps, scenes
from tests.operators.tracking.hall_views import HallView, walk

A, B = "a" * 32, "b" * 32
FRONT = {"camera": scenes.camera()}


class _Faint(made_maps.Room):
    """Points whose 256 numbers, as many as SuperPoint's, hardly change."""

    def again(self, rows: np.ndarray, seed: int) -> np.ndarray:
        return made.with_noise(self.looks[rows].astype(np.float32), 0.015, seed)


@pytest.fixture(scope="module")
def of_numbers() -> Map:
    """Two laps in a room."""
    points = made_maps.room().points
    place = _Faint(points, made.numbers(len(points), 0, width=256))
    truth = made_maps.circle(made_maps.LAP + 6)
    return made_maps.flown(Map.empty(), place, A, truth, FRONT)


@pytest.fixture(scope="module")
def of_bits() -> Map:
    truth = made_maps.circle(made_maps.LAP + 6)
    return made_maps.flown(Map.empty(), made_maps.room(), A, truth, FRONT)


def test_D13_loops_are_found_with_an_eighth_of_the_memory(of_numbers: Map, tmp_path: Path) -> None:
    """256 numbers to 32: at least 95 % of the loops that whole descriptors find."""
    small, report = compress_descriptors(of_numbers, CompressConfig())
    save_map(small, tmp_path)

    kept = load_map(tmp_path)
    whole_loops = find_visual_loops(of_numbers)[1].num_accepted
    small_loops = find_visual_loops(kept)[1].num_accepted

    (done,) = report.kinds
    assert done.num_bytes * 8 == done.num_bytes_before
    sizes = [sum(map(len, m.feature_sets.descriptors)) for m in (of_numbers, kept)]
    assert sizes[1] * 8 == sizes[0]
    assert check_map(kept) == []
    assert whole_loops >= 5
    assert small_loops >= 0.95 * whole_loops


@pytest.mark.slow
def test_D13_sift_matches_as_well_with_32_numbers_in_w_vi() -> None:
    """True matches of two views of W-VI that are 0.35 m apart: at least 95 % of those by 128 numbers."""
    views = walk(11, 0)
    sift = make_detector("sift", DetectorOptions())
    before, now = (sift.detect(views[i].image) for i in (0, 7))
    learnt = [sift.detect(views[i].image).descriptors for i in (2, 4)]
    projection = principal_components(np.concatenate(learnt), "sift", 32)

    def num_true(first: np.ndarray, second: np.ndarray) -> int:
        # distances count here, the cosine of what is off the mean says nothing
        rules = MatchRules(min_similarity=0, max_ratio=0.8)
        pairs = matched(first, second, rules)
        error_px = np.linalg.norm(
            views[0].px_in(views[7], before.px[pairs[:, 0]]) - now.px[pairs[:, 1]], axis=1
        )
        return int((error_px < 3).sum())

    whole = num_true(before.descriptors, now.descriptors)
    small = num_true(projection(before.descriptors), projection(now.descriptors))
    assert whole >= 100
    assert small >= 0.95 * whole


def test_D13_what_comes_later_is_compressed_alike(of_numbers: Map) -> None:
    small, _ = compress_descriptors(of_numbers, CompressConfig())
    late = of_numbers.feature_sets.vertex >= 10
    mixed = replace(
        small,
        feature_sets=replace(
            small.feature_sets,
            width=np.where(late, of_numbers.feature_sets.width, small.feature_sets.width),
            descriptors=np.where(
                late, of_numbers.feature_sets.descriptors, small.feature_sets.descriptors
            ),
        ),
    )

    again, report = compress_descriptors(mixed, CompressConfig())

    assert again.digest() == small.digest()
    assert 0 < report.kinds[0].num_descriptors < len(of_numbers.observations)
    assert compress_descriptors(small, CompressConfig())[1].kinds[0].num_descriptors == 0


@pytest.mark.anyio
async def test_D13_queries_are_compressed_as_the_map_was(of_numbers: Map, tmp_path: Path) -> None:
    small, _ = compress_descriptors(of_numbers, CompressConfig())
    save_map(small, tmp_path / "small")
    save_map(of_numbers, tmp_path / "whole")
    rows = np.flatnonzero(small.observations.vertex == 3)
    query = ImageFeatures(
        stamp_ns=0,
        kind=made_maps.KIND,
        frame="camera",
        keypoints_px=small.observations.keypoint_px[rows],
        descriptors=descriptors_of(of_numbers, rows),
    )
    other = replace(query, kind="orb")

    sent = await run_operator(
        CompressDescriptors(CompressDescriptorsConfig(map=tmp_path / "small")),
        features=[query, other],
    )

    found, untouched = sent["features"]
    np.testing.assert_allclose(found.descriptors, descriptors_of(small, rows), atol=1e-6)
    assert untouched is other
    with pytest.raises(MapError, match="takes 256 numbers or bits, not 32"):
        compressed(found, projections_of(small, "compression"))
    with pytest.raises(ConfigError, match="nothing is compressed in this map; `mapstream map"):
        await run_operator(
            CompressDescriptors(CompressDescriptorsConfig(map=tmp_path / "whole")), features=[query]
        )


def test_D14_a_projection_is_trained_from_a_map_and_stays_with_it(
    of_bits: Map, tmp_path: Path
) -> None:
    trained, report = train_projection(of_bits, TrainProjectionConfig())
    save_map(trained, tmp_path)

    projection = projections_of(load_map(tmp_path), "index")[made_maps.KIND]

    assert projection.matrix.shape == (512, 10)
    assert report.kinds[0].separation > 2


@pytest.mark.slow
def test_D14_a_trained_projection_loses_fewer_points_than_principal_components() -> None:
    """BRISK in W-VI, 10 numbers: of points 0.35 m later, at most 0.75 times as many are not among the 20 nearest."""
    brisk = make_detector("brisk", DetectorOptions())
    turning, ahead = walk(10, 30.0), walk(11, 0)
    found = [brisk.detect(view.image) for view in turning]
    same = []
    for i in range(len(turning) - 1):
        a, b = _true_pairs(turning[i], turning[i + 1], found[i], found[i + 1])
        same.append(as_numbers(found[i].descriptors[a]) - as_numbers(found[i + 1].descriptors[b]))
    everything = np.concatenate([each.descriptors for each in found])
    a, b = np.random.default_rng(0).integers(0, len(everything), (2, 4000))
    different = as_numbers(everything[a]) - as_numbers(everything[b])
    first, second = (brisk.detect(ahead[i].image) for i in (0, 7))
    rows, truth = _true_pairs(ahead[0], ahead[7], first, second)

    def missed(project: Callable[[np.ndarray], np.ndarray]) -> float:
        queries, stored = project(first.descriptors[rows]), project(second.descriptors)
        nearest = np.argsort(((queries[:, None] - stored) ** 2).sum(axis=2), axis=1)[:, :20]
        return 1 - float((nearest == truth[:, None]).any(axis=1).mean())

    trained = separating(np.concatenate(same), different, "brisk", 10)
    assert len(rows) >= 200
    assert missed(trained) <= 0.75 * missed(learn_projection(everything, 10))


def _true_pairs(
    a: HallView, b: HallView, in_a: Detected, in_b: Detected
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of keypoints of two views that are of one point."""
    distances_px, nearest = cKDTree(in_b.px).query(a.px_in(b, in_a.px))
    rows = np.flatnonzero(distances_px < 1.5)
    return rows, nearest[rows]


def test_D14_the_directions_are_those_in_which_points_differ() -> None:
    """Of three numbers the second is noise: it is left out, though it varies more than the first."""
    rng = np.random.default_rng(0)
    same = rng.normal(0, [0.3, 1, 0.3], (4000, 3)).astype(np.float32)
    different = rng.normal(0, [0.9, 1, 2], (4000, 3)).astype(np.float32)

    matrix = separating(same, different, "bits", 2).matrix

    assert (np.abs(matrix[1]) < 0.1 * np.abs(matrix).max()).all()
    np.testing.assert_array_equal(np.abs(matrix).argmax(axis=0), [2, 0])


def test_projections_are_there_once_after_maps_come_together(of_numbers: Map) -> None:
    small, _ = compress_descriptors(of_numbers, CompressConfig())
    place = made_maps.room(of_numbers=True)
    other = made_maps.flown(Map.empty(), place, B, made_maps.circle(4), FRONT)
    both = merge_maps([small, other])
    learnt = projections_of(small, "compression")[made_maps.KIND]

    alone = select_missions(both, [B])
    for together in (merge([small, both])[0], merge_maps([small, with_projection(alone, learnt)])):
        assert len(together.projections) == 1
        assert check_map(together) == []


def test_what_cannot_be_learnt_is_named(of_numbers: Map, of_bits: Map) -> None:
    with pytest.raises(MapError, match=r"no descriptors of float32 of kind 'sift'.* \['brisk'\]"):
        compress_descriptors(of_numbers, CompressConfig(kind="sift"))
    with pytest.raises(MapError, match="256 numbers cannot be compressed to 256"):
        compress_descriptors(of_numbers, CompressConfig(dimensions=256))
    alone = replace(of_bits.observations, landmark=np.full(len(of_bits.observations), -1))
    alone = replace(alone, track=np.arange(len(alone)))
    with pytest.raises(
        MapError, match=r"0 pairs of keypoints of kind brisk are of one point.*track them"
    ):
        train_projection(replace(of_bits, observations=alone), TrainProjectionConfig())
    compress, train = CompressConfig(), TrainProjectionConfig()
    assert compress_descriptors(of_bits, compress)[1].lines()[0].startswith("no kind")
    assert train_projection(of_numbers, train)[1].lines()[0].startswith("no kind")
