"""Limits that hold for every image: how many tracks, how close, and which of two that meet goes on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist, pdist

from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.klt import Klt
from mapstream.operators.tracking.klt_tracker import KltConfig
from mapstream.operators.tracking.upkeep import TrackLimits, survivors
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.tracking.hall_views import gyro, walk

pytestmark = pytest.mark.anyio


async def test_D22_the_limits_hold_in_every_image() -> None:
    views = walk(10, 30.0)
    limits = TrackLimits()  # maplab's
    config = KltConfig(**limits.model_dump())

    out = await run_operator(
        Klt(config), frames=[v.camera_frame() for v in views], imu=gyro(views, 30.0)
    )

    known: set[int] = set()
    for found in out["features"]:
        assert 100 < len(found) <= 600
        ids = np.array(found.track_ids)
        assert len(set(ids)) == len(ids)
        is_new = ~np.isin(ids, list(known))
        new, live = found.keypoints_px[is_new], found.keypoints_px[~is_new]
        assert (new >= 30).all()
        assert (new <= [609, 449]).all()
        assert pdist(new).min(initial=np.inf) > 7
        if len(live) and len(new):
            assert cdist(new, live).min() > 7
        assert pdist(live).min(initial=np.inf) > 3
        known |= set(ids.tolist())


async def test_D22_when_two_tracks_meet_the_older_goes_on() -> None:
    rows, columns = np.mgrid[:240, :320]
    frames = []
    for i in range(16):  # a disc that stays, and from the second image on one that slides over it
        image = np.full((240, 320), 200, np.uint8)
        for x in (150, 180 - 2 * i) if i else (150,):
            image[np.hypot(columns - x, rows - 120) < 2.6] = 30
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 1), np.uint8)
        frames.append(CameraFrame(stamp_ns=i + 1, image=image, encoding="mono8", frame="left"))

    config = KltConfig(window_px=9, num_levels=0, min_distance_px=6)
    found = (await run_operator(Klt(config), frames=frames))["features"]

    (older,) = np.array(found[0].track_ids)
    (younger,) = set(np.array(found[1].track_ids)) - {older}
    assert younger in np.array(found[6].track_ids)
    assert [older in np.array(f.track_ids) for f in found] == [True] * 16
    assert younger not in np.array(found[-1].track_ids)
    assert all(pdist(f.keypoints_px).min(initial=np.inf) > 3 for f in found)


@given(
    st.lists(
        st.tuples(st.floats(0, 40, width=32), st.floats(0, 40, width=32), st.integers(0, 5)),
        max_size=40,
    )
)
@settings(max_examples=60, deadline=None)
def test_D22_a_track_ends_only_beside_one_that_is_as_old_and_goes_on(
    tracks: list[tuple[float, float, int]],
) -> None:
    px = np.array([t[:2] for t in tracks], np.float32).reshape(-1, 2)
    ages = np.array([t[2] for t in tracks], dtype=np.int64)

    kept = survivors(px, ages, 3.0)

    if kept.sum() > 1:
        assert pdist(px[kept]).min() > 3
    for row in np.flatnonzero(~kept):
        older = px[kept & (ages >= ages[row])]
        assert (np.linalg.norm(older - px[row], axis=1) <= 3 + 1e-5).any()


def test_D22_of_two_that_meet_the_older_survives() -> None:
    px = np.array([[10.0, 10.0], [12.0, 10.0], [30.0, 30.0]], np.float32)

    assert survivors(px, np.array([2, 7, 0]), 3.0).tolist() == [False, True, True]
    assert survivors(px, np.array([7, 2, 0]), 3.0).tolist() == [True, False, True]
    assert survivors(px, np.array([7, 2, 0]), 1.0).tolist() == [True, True, True]
