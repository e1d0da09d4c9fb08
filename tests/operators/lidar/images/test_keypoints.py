"""Keypoints of LiDAR images: where they are, in space and in time, and that they are found again."""

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest

from mapstream.operators.features.rows import rows_of
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.landmarks.views import views_of
from mapstream.operators.lidar.images.grid import GridConfig, ScanGrid
from mapstream.operators.lidar.images.lidar_image import LidarImage, LidarImageConfig
from mapstream.operators.lidar.images.lidar_keypoints import LidarKeypoints, LidarKeypointsConfig
from mapstream.operators.lidar.images.lidar_tracks import LidarTracks, LidarTracksConfig
from mapstream.operators.operator import Context, set_context
from mapstream.operators.places.geometry.consensus import ConsensusConfig, find_pose
from mapstream.operators.places.geometry.sightings import make_sightings
from mapstream.operators.places.views import VertexViews
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.lidar.images.corridors import Drive, mapped, off_walls_m, without_times
from tests.operators.networks.weights import installed

_LONG = 5  # scans


def keypoints(detector: Literal["orb", "brisk", "freak", "sift", "xfeat"]) -> LidarKeypoints:
    return LidarKeypoints(LidarKeypointsConfig(detector=detector))


def test_D17_each_keypoint_has_a_point_of_the_scan_and_its_time(drive: Drive) -> None:
    scan = drive.scans[0]
    assert scan.offsets_ns is not None

    found = keypoints("brisk").detect(scan)

    assert found.kind == "lidar_brisk"
    assert len(found) > 60
    assert found.stamp_ns == scan.end_ns
    assert found.points_m is not None
    assert found.offsets_ns is not None
    projected = ScanGrid(GridConfig()).project(scan)
    column, row = np.rint(found.keypoints_px).astype(int).T
    point = projected.point[row, column % projected.point.shape[1]]
    assert (point >= 0).all()
    np.testing.assert_array_equal(found.points_m, scan.points[point])
    np.testing.assert_array_equal(
        found.stamp_ns + found.offsets_ns, scan.stamp_ns + scan.offsets_ns[point]
    )


def test_D17_no_keypoint_lies_where_the_image_is_painted_over(drive: Drive) -> None:
    """A third of the image without returns, and single pixels besides; and three beams at either end are left out."""
    scan = drive.scans[0]
    yaw = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    kept = (np.abs(yaw - 1) > 1) & (np.random.default_rng(0).random(len(yaw)) > 0.1)
    assert scan.ring is not None
    assert scan.intensity is not None
    assert scan.offsets_ns is not None
    holed = replace(
        scan,
        points=scan.points[kept],
        ring=scan.ring[kept],
        intensity=scan.intensity[kept],
        offsets_ns=scan.offsets_ns[kept],
    )

    found = keypoints("orb").detect(holed)

    projected = ScanGrid(GridConfig()).project(holed)
    column, row = np.rint(found.keypoints_px).astype(int).T
    assert len(found) > 40
    assert projected.is_measured[row, column % 1024].all()
    assert row.min() >= 3
    assert row.max() <= 60


@pytest.mark.parametrize("detector", ["orb", "freak", "sift", "xfeat"])
def test_D17_any_detector_and_any_network_will_do(
    drive: Drive, detector: Literal["orb", "freak", "sift", "xfeat"]
) -> None:
    if detector == "xfeat":
        installed("xfeat")

    found = keypoints(detector).detect(drive.scans[0])

    assert found.kind == f"lidar_{detector}"
    assert len(found) > 20
    assert found.descriptors.shape[0] == len(found)
    assert found.points_m is not None


@pytest.mark.slow
def test_D17_a_network_matches_keypoints_of_lidar_images(drive: Drive) -> None:
    """XFeat and LighterGlue in the place of SuperPoint and SuperGlue: what they match must lie at one place, too."""
    installed("xfeat")
    installed("lighterglue")
    finder, tracker = keypoints("xfeat"), LidarTracks(LidarTracksConfig(matcher="lighterglue"))
    last = slice(-3, None)

    found = [
        tracker.track(finder.detect(scan), pose)
        for scan, pose in zip(drive.scans[last], drive.poses()[last], strict=True)
    ]

    assert found[0].kind == "lidar_xfeat"
    assert shared_tracks(*found[1:]) > 20


def test_D17_keypoints_do_not_end_at_the_seam(drive: Drive) -> None:
    """With the seam elsewhere the same points are found, those beside it as well."""
    scan = drive.scans[0]
    turned = replace(scan, points=scan.points[:, [1, 0, 2]] * np.array([-1, 1, 1], np.float32))

    a, b = keypoints("orb").detect(scan), keypoints("orb").detect(turned)

    assert a.points_m is not None
    assert b.points_m is not None
    back = b.points_m[:, [1, 0, 2]] * np.array([1, -1, 1], np.float32)
    near = np.abs(a.keypoints_px[:, 0] - 512) > 512 - 40  # of the seam
    again = (np.linalg.norm(a.points_m[:, None] - back, axis=2) < 1e-3).any(axis=1)
    assert near.sum() > 5
    assert again.mean() > 0.7
    assert again[near].mean() > 0.5


def test_a_larger_image_finds_keypoints_between_the_beams(drive: Drive) -> None:
    larger = LidarKeypointsConfig(pixels_per_beam=2, pixels_per_column=2)

    found = LidarKeypoints(larger).detect(drive.scans[0])

    parts = np.mod(found.keypoints_px, 1)
    np.testing.assert_allclose(parts, np.where(parts < 0.5, 0.25, 0.75), atol=1e-4)
    assert (found.keypoints_px.max(axis=0) < [1024, 64]).all()


def test_D17_landmarks_of_tracks_lie_on_the_walls(
    drive: Drive, tracks: list[ImageFeatures]
) -> None:
    """Across the walls they spread by less than 3 cm, where 5 are asked for."""
    map_, report = create_landmarks(mapped(drive, [[each] for each in tracks]))
    count = np.bincount(map_.observations.landmark[map_.observations.landmark >= 0])

    points = map_.T_map_landmark(np.flatnonzero(count >= 3))[:, :3, 3]
    off_m = off_walls_m(drive, points)
    on_wall = np.abs(off_m) < 0.3  # others are behind a corner, as seen from amid the drive

    assert check_map(map_) == []
    assert report.num_found == len(map_.landmarks)
    assert (count >= 3).sum() > 100
    assert on_wall.sum() > 60
    assert on_wall.sum() > 0.8 * np.isfinite(off_m).sum()
    assert off_m[on_wall].std() < 0.03


def spreads_m(map_: Map, least: int) -> FloatArray:
    """How far the sightings of landmarks are from their means, for landmarks with so many (rms)."""
    rows = np.flatnonzero(map_.observations.landmark >= 0)
    landmark, points = map_.observations.landmark[rows], views_of(map_, rows).points
    count = np.bincount(landmark)
    means = np.stack([np.bincount(landmark, axis) for axis in points.T], axis=1) / count[:, None]
    squared = ((points - means[landmark]) ** 2).sum(axis=1)
    rms: FloatArray = np.sqrt(np.bincount(landmark, squared) / count)
    return rms[count >= least]


def test_E16_sightings_of_a_landmark_meet_only_with_their_times(
    drive: Drive, tracks: list[ImageFeatures]
) -> None:
    """W-LID at 90 deg/s: those seen five times spread by less than 5 cm, without times by more than 15 cm."""
    map_, _ = create_landmarks(mapped(drive, [[each] for each in tracks]))

    with_times, without = (spreads_m(each, _LONG) for each in (map_, without_times(map_)))

    assert len(with_times) >= 25
    assert np.median(with_times) < 0.05
    assert np.median(without) > 0.15


def sightings_at(map_: Map, vertex: int, outliers: float, seed: int) -> tuple[FloatArray, IntArray]:
    """The landmarks (N, 3) that keypoints (N,) of a vertex see, by what other vertices saw; some are exchanged."""
    seen = map_.observations
    own = np.flatnonzero((seen.vertex == vertex) & (seen.landmark >= 0))
    others = np.flatnonzero((seen.vertex != vertex) & np.isin(seen.track, seen.track[own]))
    points = views_of(map_, others).points
    own = own[np.isin(seen.track[own], seen.track[others])]
    landmarks = np.array([points[seen.track[others] == track].mean(axis=0) for track in seen.track[own]])  # fmt: skip
    rng = np.random.default_rng(seed)
    false = rng.permutation(len(own))[: round(outliers * len(own))]
    landmarks[false] = landmarks[np.roll(false, 1)]
    return landmarks, own


@pytest.mark.parametrize("vertex", [3, 6, 9])
def test_H8_half_of_what_a_lidar_sees_is_false_and_its_place_is_found(
    drive: Drive, tracks: list[ImageFeatures], vertex: int
) -> None:
    """Within 5 cm and 0.3 degrees, while it spins at 90 deg/s."""
    map_, _ = create_landmarks(mapped(drive, [[each] for each in tracks]))
    (view,) = VertexViews(map_).at(vertex)
    landmarks, own = sightings_at(map_, vertex, 0.5, seed=vertex)
    rows = np.searchsorted(view.rows, own)
    sightings = make_sightings(
        (view.sensor,),
        sensor=np.zeros(len(own), np.int64),
        points_map=landmarks,
        keypoints_px=view.keypoints_px[rows],
        points_sensor=view.points_sensor[rows],
        sigmas_m=view.sigmas_m[rows],
    )

    found = find_pose(sightings, ConsensusConfig(), seed=vertex)

    off = drive.poses()[vertex].inverse() @ found.pose.T_map_base
    assert len(own) > 40
    assert float(np.linalg.norm(off.t)) < 0.05
    assert np.rad2deg(off.angle_rad) < 0.3


def shared_tracks(a: ImageFeatures, b: ImageFeatures) -> int:
    assert a.track_ids is not None
    assert b.track_ids is not None
    return len(np.intersect1d(a.track_ids, b.track_ids))


def test_D17_without_odometry_the_keypoints_tell_the_motion(
    drive: Drive, tracks: list[ImageFeatures]
) -> None:
    """Most points are followed that the true motion would follow, while the spin changes from one side to the other."""
    follower = LidarTracks(LidarTracksConfig())

    alone = [follower.track(replace(each, track_ids=None)) for each in tracks]

    num_alone = [shared_tracks(a, b) for a, b in pairwise(alone)]
    num_aided = [shared_tracks(a, b) for a, b in pairwise(tracks)]
    assert min(num_aided[1:]) > 20  # nobody knows how the sensor moved within the first scan
    assert sum(num_alone) > 0.5 * sum(num_aided)


@pytest.mark.anyio
async def test_D17_tracks_need_the_odometry_of_their_stamp(drive: Drive) -> None:
    """The operators one after the other; a scan without odometry is followed by itself, and that is told."""
    config = LidarKeypointsConfig(image=LidarImageConfig(columns=512))
    scans, poses = drive.scans[-3:], drive.poses()[-3:]
    found = (await run_operator(LidarKeypoints(config), scans=scans))["features"]
    odometry = [
        Odometry(stamp_ns=scan.end_ns, T_odom_base=pose)
        for scan, pose in zip(scans, poses, strict=True)
    ]
    context = Context()

    sent = await run_operator(
        LidarTracks(LidarTracksConfig()),
        run_context=context,
        features=found,
        odometry=odometry[:2],
    )

    assert [each.stamp_ns for each in sent["features"]] == [scan.end_ns for scan in scans]
    assert shared_tracks(sent["features"][1], sent["features"][2]) > 10
    assert any("without odometry within 1 ms" in text for text in context.activity.warnings)


@pytest.mark.anyio
async def test_images_may_be_painted_by_another_operator(drive: Drive) -> None:
    scans = drive.scans[:2]
    frames = (await run_operator(LidarImage(LidarImageConfig()), scans=scans))["frames"]

    sent = await run_operator(keypoints("orb"), scans=scans, frames=frames)

    alone = keypoints("orb")
    for features, scan in zip(sent["features"], scans, strict=True):
        expected = alone.detect(scan)
        assert features.stamp_ns == expected.stamp_ns == scan.end_ns
        np.testing.assert_array_equal(features.points_m, expected.points_m)


def test_an_image_of_another_size_is_refused(drive: Drive) -> None:
    frame = LidarImage(LidarImageConfig(columns=512)).image(drive.scans[0])

    with pytest.raises(OperatorError, match="give lidar_keypoints the `rows` and `columns`"):
        keypoints("orb").detect(drive.scans[0], frame)


def test_keypoints_without_points_are_refused() -> None:
    plain = ImageFeatures(
        stamp_ns=0, kind="orb", frame="camera", keypoints_px=np.zeros((2, 2), np.float32)
    )

    with pytest.raises(OperatorError, match="no 3D points; `feature_tracker` follows such"):
        LidarTracks(LidarTracksConfig()).track(plain)


def test_scans_without_keypoints_are_followed_as_well(drive: Drive) -> None:
    set_context(Context())
    follower = LidarTracks(LidarTracksConfig())
    some = keypoints("orb").detect(drive.scans[0])
    none = rows_of(some, np.empty(0, np.int64))

    numbers = [follower.track(each, SE3.identity()).track_ids for each in (some, none, some)]

    assert numbers[0] is not None
    np.testing.assert_array_equal(numbers[0], numbers[2])
