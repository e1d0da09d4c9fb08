"""Tracks that others made: outliers are dropped, and nothing is renamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.track_filter import TrackFilter, TrackFilterConfig
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures
from tests.operators.tracking.hall_views import CAMERA, PERIOD_NS, T_BASE_CAMERA, gyro, walk

pytestmark = pytest.mark.anyio
_WRONG = np.arange(0, 150, 5)  # rows of tracks that jump about


def _tracks(kind: str = "mine") -> list[ImageFeatures]:
    """Return 6 images of 150 points, whose numbers have holes and no order, and 10 keypoints of no track."""
    rng = np.random.default_rng(2)
    points = rng.uniform([-3, -2, 3], [3, 2, 12], (150, 3))
    ids = rng.permutation(10_000)[:150] * 7
    found = []
    for i in range(6):
        T_camera_start = SE3.exp([0, 0, 0, 0.03 * i, 0.01 * i, -0.05 * i])
        px = project(CAMERA, T_camera_start @ points)[0] + rng.normal(0, 0.3, (150, 2))
        px[_WRONG] += rng.uniform(-30, 30, (len(_WRONG), 2))
        loose = rng.uniform([0, 0], [639, 479], (10, 2))
        found.append(
            ImageFeatures(
                stamp_ns=(i + 1) * PERIOD_NS,
                kind=kind,
                frame="front",
                keypoints_px=np.concatenate([px, loose]),
                track_ids=np.append(ids, np.full(10, NO_TRACK)),
                camera=CAMERA,
                T_base_sensor=T_BASE_CAMERA,
            )
        )
    return found


async def test_D8_outliers_are_dropped_for_good_and_ids_stay() -> None:
    given = _tracks()
    views = walk(6, 0.0)

    out = await run_operator(TrackFilter(TrackFilterConfig()), features=given, imu=gyro(views, 0.0))

    wrong = set(np.array(given[0].track_ids)[_WRONG])
    before = set(np.array(given[0].track_ids))
    for a, b in zip(given, out["features"], strict=True):
        places = {tuple(px): i for px, i in zip(a.keypoints_px, np.array(a.track_ids), strict=True)}
        kept = {tuple(px): i for px, i in zip(b.keypoints_px, np.array(b.track_ids), strict=True)}
        assert kept.items() <= places.items()  # nothing is moved, nothing is renamed
        assert set(kept.values()) <= before  # what was dropped does not come back
        assert list(kept.values()).count(NO_TRACK) == 10
        before = set(kept.values())
    assert len(before & wrong) <= 0.05 * len(wrong)
    assert len(before - wrong) >= 0.95 * (150 - len(wrong))


async def test_D8_without_rotation_or_tracks_nothing_is_dropped() -> None:
    given = _tracks()
    views = walk(6, 0.0)
    late = [replace(b, stamps_ns=b.stamps_ns + 10**12) for b in gyro(views, 0.0)]

    out = await run_operator(TrackFilter(TrackFilterConfig()), features=given, imu=late)

    assert [len(f) for f in out["features"]] == [160] * 6
    bare = [replace(f, track_ids=None) for f in given]
    out = await run_operator(TrackFilter(TrackFilterConfig()), features=bare, imu=gyro(views, 0.0))
    assert out["features"] == bare


async def test_D15_each_kind_and_operator_obeys_its_own_parameters() -> None:
    given = [f for pair in zip(_tracks("one"), _tracks("two"), strict=True) for f in pair]
    views = walk(6, 0.0)

    strict, lax = [
        await run_operator(
            TrackFilter(TrackFilterConfig(max_outlier_angle_deg=angle)),
            features=given,
            imu=gyro(views, 0.0),
        )
        for angle in (0.5, 20.0)
    ]

    for kind in ("one", "two"):
        last = [[f for f in out["features"] if f.kind == kind][-1] for out in (strict, lax)]
        assert len(last[0]) < 140
        assert len(last[1]) > 155
