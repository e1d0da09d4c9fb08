"""Objects as keypoints: they reach the map with their tracks, classes, masks and centres."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.features.rows import rows_of
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.landmarks.views import POINT_SIGMA_M
from mapstream.operators.objects.object_features import ObjectFeatures, ObjectFeaturesConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import check_map
from mapstream.recordings.maps.features import add_features, descriptors_of
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.objects.made_detections import detections
from tests.recordings.made_maps import line_map

pytestmark = pytest.mark.anyio
INSIDE, AT_THE_BORDER = (20, 10, 30, 30), (50, 20, 63.5, 30)


def features_of(seen: ObjectDetections) -> ImageFeatures:
    return ObjectFeatures(ObjectFeaturesConfig()).features(seen)


async def test_each_image_gives_one_message_also_without_objects() -> None:
    seen = [detections([INSIDE], 10), detections([], 20)]

    out = await run_operator(ObjectFeatures(ObjectFeaturesConfig()), detections=seen)

    assert [(f.stamp_ns, len(f), f.kind) for f in out["features"]] == [
        (10, 1, "object"),
        (20, 0, "object"),
    ]


def test_the_keypoint_is_the_middle_of_the_box() -> None:
    found = features_of(detections([INSIDE]))

    np.testing.assert_allclose(found.keypoints_px, [[25, 20]])
    assert found.sigmas_px is not None
    np.testing.assert_allclose(found.sigmas_px, 0.05 * 20)


@pytest.mark.parametrize(
    "box", [(-0.5, 20, 9.5, 30), (20, -0.5, 30, 9.5), (53, 20, 63.5, 30), (20, 37, 30, 47.5)]
)
def test_the_middle_of_what_the_border_cuts_is_hardly_known(
    box: tuple[float, float, float, float],
) -> None:
    """Its 3D centre neither: half of what is seen of it may be missing, 10 px at 2 m with f = 50 px."""
    seen = detections([box], centers_m=np.array([[0, 0, 2.0]]), center_sigmas_m=np.array([0.01]))

    found = features_of(seen)

    assert found.sigmas_px is not None
    assert found.point_sigmas_m is not None
    np.testing.assert_allclose(found.sigmas_px, 0.5 * 10, rtol=0.1)
    np.testing.assert_allclose(found.point_sigmas_m, np.hypot(0.01, found.sigmas_px * 2 / 50))


def test_unknown_centres_and_descriptors_stay_unknown() -> None:
    found = features_of(
        detections(
            [INSIDE, AT_THE_BORDER],
            centers_m=np.array([[0, 0, 2.0], [np.nan] * 3]),
            descriptors=np.array([[0.6, 0.8], [np.nan, np.nan]]),
        )
    )

    assert found.point_sigmas_m is not None
    np.testing.assert_array_equal(found.points_m, np.array([[0, 0, 2], [np.nan] * 3]))
    np.testing.assert_allclose(found.point_sigmas_m, POINT_SIGMA_M)
    np.testing.assert_allclose(found.descriptors, np.array([[0.6, 0.8], [0, 0]]))


def test_some_keypoints_are_of_some_objects() -> None:
    found = rows_of(
        features_of(detections([INSIDE, AT_THE_BORDER], labels=("cup", "book"))), np.array([1])
    )

    assert found.objects is not None
    assert found.objects.labels == ("book",)
    np.testing.assert_allclose(found.keypoints_px, [[56.75, 25]])


def test_a_tracked_object_becomes_a_landmark_of_its_class() -> None:
    map_ = line_map(3)
    vertices = [0, 1]
    seen = [
        features_of(
            detections(
                [INSIDE],
                stamp_ns,
                track_ids=np.array([7]),
                descriptors=np.array([[0.6, 0.8]]),
                masks=(np.eye(21, 11, dtype=bool),),
                centers_m=np.array([[0.0, 0.0, 2.0]]),
            )
        )
        for stamp_ns in map_.vertices.stamp_ns[vertices].tolist()
    ]
    map_ = add_features(map_, 0, [(v, f.stamp_ns, f) for v, f in zip(vertices, seen, strict=True)])

    made, _ = create_landmarks(map_)

    assert check_map(made) == []
    is_object = made.landmarks.kind == "object"
    assert made.landmarks.label[is_object].tolist() == ["cup"]
    rows = np.flatnonzero(made.observations.landmark == np.flatnonzero(is_object)[0])
    np.testing.assert_allclose(descriptors_of(made, rows), np.array([[0.6, 0.8]] * 2))
