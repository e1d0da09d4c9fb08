"""Keypoints become observations of the map, with descriptors and cameras that can be had again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.cameras import Camera, cameras_of, with_cameras
from mapstream.recordings.maps.features import KEYPOINT_SIGMA_PX, descriptors_of
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import ImageFeatures
from tests.recordings.made_maps import keyframe, line_map, submaps

CAMERA = CameraCalibration(
    frame="cam0",
    width_px=640,
    height_px=480,
    focal_px=np.array([400.0, 401.0]),
    center_px=np.array([320.0, 240.0]),
    distortion="fov",
    distortion_parameters=np.array([0.9]),
    line_delay_ns=30_000,
)


def features(index: int, kind: str, n: int = 3, frame: str = "cam0") -> ImageFeatures:
    rng = np.random.default_rng([index, n])
    bits, numbers = rng.integers(0, 256, (n, 8), np.uint8), rng.normal(size=(n, 4))
    return ImageFeatures(
        stamp_ns=keyframe(index).stamp_ns + 200,
        kind=kind,
        frame=frame,
        keypoints_px=rng.uniform(0, 400, (n, 2)).astype(np.float32),
        descriptors=bits if kind == "orb" else numbers.astype(np.float32),
        scores=rng.uniform(size=n).astype(np.float32),
        scales=rng.uniform(size=n).astype(np.float32),
        orientations_rad=rng.uniform(size=n).astype(np.float32),
        track_ids=np.arange(n) - 1,
        offsets_ns=np.arange(n) * 10,
        T_base_sensor=SE3.exp([0.1, 0, 0, 0, 0.2, 0]),
        camera=CAMERA,
    )


def map_of(per_keyframe: Sequence[tuple[ImageFeatures, ...]]) -> Map:
    [submap] = submaps([len(per_keyframe) - 1])
    frames = tuple(
        replace(frame, features=seen)
        for frame, seen in zip(submap.keyframes, per_keyframe, strict=True)
    )
    return append_submap(Map.empty(), replace(submap, keyframes=frames))


def test_D9_D19_kinds_side_by_side_keep_all_that_is_known_of_keypoints() -> None:
    seen = [(features(i, "orb", 3), features(i, "sift", 2)) for i in range(4)]
    map_ = map_of(seen)

    assert check_map(map_) == []
    for kind in (0, 1):
        given_sets = [both[kind] for both in seen]
        rows = np.flatnonzero(map_.observations.kind == given_sets[0].kind)
        table = map_.observations
        for column, name in (
            (table.keypoint_px, "keypoints_px"),
            (table.score, "scores"),
            (table.scale, "scales"),
            (table.orientation_rad, "orientations_rad"),
            (table.track, "track_ids"),
        ):
            expected = np.concatenate([getattr(f, name) for f in given_sets])
            np.testing.assert_array_equal(column[rows], expected)
        expected = np.concatenate([f.descriptors for f in given_sets])
        np.testing.assert_array_equal(descriptors_of(map_, rows), expected)
        offsets = np.concatenate([200 + np.asarray(f.offsets_ns) for f in given_sets])
        np.testing.assert_array_equal(table.offset_ns[rows], offsets)
    assert (map_.observations.sigma == np.float32(KEYPOINT_SIGMA_PX)).all()
    assert (map_.observations.landmark == -1).all()


@given(st.permutations(range(8)))
def test_descriptors_follow_their_observations_through_selections(order: list[int]) -> None:
    map_ = map_of([(features(i, "orb", 2),) for i in range(4)])
    rows = np.array(order[:5])
    expected = descriptors_of(map_, np.arange(8))[rows]

    np.testing.assert_array_equal(descriptors_of(map_, rows), expected)
    keep = np.isin(np.arange(8), rows)
    chosen = in_canonical_order(map_.select(observations=keep))
    np.testing.assert_array_equal(
        descriptors_of(chosen, np.arange(5)), descriptors_of(map_, np.flatnonzero(keep))
    )


def test_cameras_are_known_from_the_features_and_can_be_changed() -> None:
    map_ = map_of([(features(0, "orb"),), (features(1, "orb", frame="cam1"),)])

    cameras = cameras_of(map_, 0)

    assert list(cameras) == ["cam0", "cam1"]
    found = cameras["cam0"].calibration
    assert (found.distortion, found.line_delay_ns, found.width_px) == ("fov", 30_000, 640)
    np.testing.assert_array_equal(found.focal_px, CAMERA.focal_px)
    moved = SE3.exp([0, 0, 0.5, 1, 2, 3])
    changed = with_cameras(map_, 0, {"cam1": Camera(calibration=CAMERA, T_base_sensor=moved)})
    np.testing.assert_allclose(cameras_of(changed, 0)["cam1"].T_base_sensor.matrix, moved.matrix)
    assert cameras_of(changed, 0)["cam0"].calibration.xi is None


def test_descriptors_that_are_not_there_or_not_alike_are_an_error() -> None:
    map_ = map_of([(features(0, "orb"), features(0, "sift")), ()])

    with pytest.raises(MapError, match="several shapes"):
        descriptors_of(map_, np.arange(6))
    bare = ImageFeatures(
        stamp_ns=1_000, kind="klt", frame="cam0", keypoints_px=np.ones((2, 2), np.float32)
    )
    with pytest.raises(MapError, match="2 observations have no descriptor"):
        descriptors_of(map_of([(bare,), ()]), np.arange(2))
    assert cameras_of(line_map(2), 0) == {}
