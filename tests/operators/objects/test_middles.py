"""Keypoints of objects: where the middle of the thing is in the image, which is not the middle of its box."""

import numpy as np
import pytest

from mapstream.operators.objects.landmarks.object_landmarks import object_landmarks
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from tests.operators.objects.object_worlds import CAMERA, Thing, around, detections, map_of

CHAIR = Thing("chair", (-0.6, 0.2, 0.4), (0.6, 0.4, 0.9), yaw=0.4)


def seen_around(num_points: int, *, chair: Thing = CHAIR) -> Map:
    poses = around(24, radius=1.9)
    seen = [detections(T, 1_000 + n, [chair], [0], num_points=num_points) for n, T in enumerate(poses)]  # fmt: skip
    return map_of(poses, seen)


def off_px(map_: Map, chair: Thing = CHAIR) -> FloatArray:
    """Return how far (N,) keypoints are from where the middle of the chair is in their images."""
    T = map_.vertices.T_mission_base[map_.observations.vertex]
    p = np.einsum("nji,nj->ni", T[:, :3, :3], chair.center - T[:, :3, 3])
    true_px = p[:, :2] / p[:, 2:] * CAMERA.focal_px + CAMERA.center_px
    away: FloatArray = np.linalg.norm(map_.observations.keypoint_px - true_px, axis=1)
    return away


@pytest.mark.parametrize("height_m", [0.4, 0.75])
def test_keypoints_are_where_the_middle_of_the_thing_is(height_m: float) -> None:
    """From near a box shows more of what is near; and the upper border of the image cuts a chair that stands higher."""
    chair = Thing("chair", (-0.6, 0.2, height_m), CHAIR.extent, CHAIR.yaw)
    before = seen_around(150, chair=chair)

    after, _ = object_landmarks(before)

    assert np.median(off_px(before, chair)) > 6
    assert np.median(off_px(after, chair)) < 2
    assert off_px(after, chair).max() < off_px(before, chair).max() / 3


def test_without_points_the_middle_of_the_box_is_all_that_is_known() -> None:
    before = seen_around(0)

    after, _ = object_landmarks(before)

    np.testing.assert_array_equal(after.observations.keypoint_px, before.observations.keypoint_px)


def test_keypoints_do_not_depend_on_what_was_found_before() -> None:
    once, _ = object_landmarks(seen_around(150))
    twice, _ = object_landmarks(once)

    np.testing.assert_array_equal(twice.observations.keypoint_px, once.observations.keypoint_px)
