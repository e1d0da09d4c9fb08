"""Keypoints, tracks, matches and what ended, over their images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from mapstream.graph.blueprint import blueprint_of
from mapstream.graph.tap_outputs import drawn_outputs
from mapstream.graph.views.colors import ramp_colors
from mapstream.operators.features.features import Orb
from mapstream.operators.lidar.images.lidar_image import LidarImage
from mapstream.operators.lidar.images.lidar_keypoints import LidarKeypoints
from mapstream.operators.lidar.images.lidar_tracks import LidarTracks
from mapstream.operators.objects.object_measurements import ObjectMeasurements
from mapstream.operators.objects.tracking.object_tracker import ObjectTracker
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.tracking.klt import Klt
from mapstream.operators.tracking.n_frames import NFrames
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures, NFrame
from tests.graph.made_plans import make_plan, node
from tests.graph.rrd import values_of
from tests.graph.test_views import drawn

_FIRST = ImageFeatures(
    stamp_ns=10**9,
    kind="klt",
    frame="left",
    keypoints_px=np.array([[10, 10], [50, 20], [90, 30], [5, 70]]),
    track_ids=np.array([7, 8, 9, NO_TRACK]),
)


def test_P4_tracks_have_tails_in_the_colour_of_their_length(tmp_path: Path) -> None:
    images = [
        replace(
            _FIRST,
            stamp_ns=_FIRST.stamp_ns + i * 50_000_000,
            keypoints_px=_FIRST.keypoints_px + np.array([2 * i, 0], np.float32),
            track_ids=np.array([7, 8, 9 if i < 15 else 100 + i, NO_TRACK]),
        )
        for i in range(20)
    ]

    entities = drawn(tmp_path, images)

    tails = values_of(entities["/op/port/tails"], "LineStrips2D:strips")
    assert [[len(strip) for strip in strips] for strips in tails[:2]] == [[1] * 3, [2] * 3]
    assert [len(strip) for strip in tails[-1]] == [12, 12, 1]
    np.testing.assert_allclose(np.array(tails[-1][0])[:, 0], 10 + 2 * np.arange(8, 20))
    colors = values_of(entities["/op/port/tracks"], "Points2D:colors")
    assert colors[-1] == ramp_colors(np.array([20.0, 20.0, 1.0]), -3, 30).tolist()
    ended = values_of(entities["/op/port/ended"], "Points2D:positions")
    assert [len(points) for points in ended] == [0] * 15 + [1] * 5
    assert ended[15] == [[90 + 2 * 14, 30]]
    assert [len(p) for p in values_of(entities["/op/port"], "Points2D:positions")] == [1] * 20
    lengths = values_of(entities["/op/port/mean_length"], "Scalars:scalars")
    assert lengths[0] == [1.0]
    assert lengths[-1] == [(20 + 20 + 1) / 3]


def test_P4_lines_lead_to_the_same_points_in_the_other_camera(tmp_path: Path) -> None:
    right = replace(
        _FIRST, frame="right", keypoints_px=_FIRST.keypoints_px - np.array([4, 0], np.float32),
        track_ids=np.array([9, 8, NO_TRACK, NO_TRACK]),
    )  # fmt: skip
    later = replace(right, stamp_ns=right.stamp_ns + 50_000_000)

    entities = drawn(tmp_path, [_FIRST, right, later])

    none, lines, too_late = values_of(entities["/op/port/matches"], "LineStrips2D:strips")
    assert none == too_late == []
    assert sorted(lines) == [[[50, 20], [46, 20]], [[90, 30], [6, 10]]]


def test_an_n_frame_is_a_plot_of_counts(tmp_path: Path) -> None:
    other = replace(_FIRST, kind="sift", keypoints_px=np.ones((2, 2), np.float32), track_ids=None)

    entities = drawn(tmp_path, [NFrame(stamp_ns=10**9, features=(_FIRST, other))])

    assert values_of(entities["/op/port/left/klt"], "Scalars:scalars") == [[4.0]]
    assert values_of(entities["/op/port/left/sift"], "Scalars:scalars") == [[2.0]]


def test_P4_each_image_of_a_pair_shows_its_own_keypoints() -> None:
    images = node(McapSource, path="x.mcap", topics={
        "left": {"topic": "/l", "type": "CameraFrame"}, "right": {"topic": "/r", "type": "CameraFrame"},
    })  # fmt: skip
    plan = make_plan(
        {"cameras": images, "klt": node(Klt), "joined": node(NFrames, inputs=["a", "b"])},
        "cameras.left -> klt.frames",
        "cameras.right -> klt.right_frames",
        "klt.features -> joined.a",
        "klt.right_features -> joined.b",
    )

    views = list(_views(blueprint_of(plan, drawn_outputs(plan)).root_container))

    assert [view.name for view in views][:3] == ["cameras/left", "cameras/right", "Operators"]
    contents = {view.name: view.contents for view in views if "cameras" in str(view.name)}
    assert contents == {
        f"cameras/{side}": [
            f"+ /cameras/{side}/**",
            f"+ /klt/{features}/**",
            f"- /klt/{features}/points/**",  # those lie in space
        ]
        for side, features in (("left", "features"), ("right", "right_features"))
    }


def test_D17_keypoints_of_a_lidar_lie_over_its_image_and_in_space(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9], [np.nan] * 3], np.float32)
    mounted = SE3.exp([0, 0, 0, 1, 0, 0])
    lidar = replace(_FIRST, frame="os", points_m=points, T_base_sensor=mounted)
    sensors = node(
        McapSource, path="x.mcap", topics={"scans": {"topic": "/s", "type": "LidarScan"}}
    )
    plan = make_plan(
        {"sensors": sensors, "image": node(LidarImage), "found": node(LidarKeypoints), "tracks": node(LidarTracks)},
        "sensors.scans -> image.scans",
        "sensors.scans -> found.scans",
        "image.frames -> found.frames",
        "found.features -> tracks.features",
    )  # fmt: skip

    entities = drawn(tmp_path, [lidar, replace(lidar, stamp_ns=2 * 10**9, track_ids=None)])
    views = {str(v.name): v for v in _views(blueprint_of(plan, drawn_outputs(plan)).root_container)}

    seen = values_of(entities["/op/port/points"], "Points3D:positions")
    np.testing.assert_array_equal(seen, [points.tolist()] * 2)
    assert "+ /found/features/**" in views["image/frames"].contents
    assert "+ /found/features/points/**" in views["Map"].contents


def test_objects_lie_over_their_image_and_in_space_also_if_they_were_recorded() -> None:
    sensors = node(
        McapSource,
        path="x.mcap",
        topics={
            "images": {"topic": "/i", "type": "CameraFrame"},
            "objects": {"topic": "/o", "type": "ObjectDetections"},
            "odometry": {"topic": "/d", "type": "Odometry"},
        },
    )
    plan = make_plan(
        {
            "sensors": sensors,
            "looks": node(Orb),
            "found": node(ObjectTracker),
            "things": node(ObjectMeasurements),
            "sink": node(
                Trajectory, sources={"odometry": {"kind": "odometry"}}, constraints={"things": {}}
            ),
        },
        "sensors.images -> looks.frames",
        "sensors.objects -> found.detections",
        "found.detections -> things.detections",
        "sensors.odometry -> things.odometry",
        "sensors.odometry -> sink.odometry",
        "things.constraints -> sink.things",
    )

    views = {str(v.name): v for v in _views(blueprint_of(plan, drawn_outputs(plan)).root_container)}

    picture, space = views["sensors/images"].contents, views["Map"].contents
    for path in ("sensors/objects", "found/detections"):
        assert f"+ /{path}/**" in picture
        assert f"- /{path}/points/**" in picture
        assert f"+ /{path}/points/**" in space
    assert "+ /things/constraints/**" in space


def _views(container: rrb.Container) -> Iterator[Any]:
    for child in container.contents:
        if isinstance(child, rrb.Container):
            yield from _views(child)
        else:
            yield child
