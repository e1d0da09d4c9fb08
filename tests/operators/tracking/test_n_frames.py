"""Images that were taken together become one n-frame, whatever comes late or not at all."""

from __future__ import annotations

import anyio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from mapstream.operators.operator import Context
from mapstream.operators.submaps.keyframes import Keyframes, KeyframesConfig
from mapstream.operators.submaps.submap_builder import SubmapBuilder, SubmapBuilderConfig
from mapstream.operators.testing import run_operator
from mapstream.operators.tracking.n_frames import NFrames, NFramesConfig
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.messages.vision import ImageFeatures, NFrame
from tests.operators.trajectory.drives import imu, odometry

pytestmark = pytest.mark.anyio

MS = 1_000_000
PERIOD_NS = 50 * MS


def features(stamp_ns: int, frame: str = "left", n: int = 3) -> ImageFeatures:
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind="klt",
        frame=frame,
        keypoints_px=np.full((n, 2), stamp_ns % 97, np.float32),
        track_ids=np.arange(n),
    )


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 400_000)), max_size=12))
def test_A3_every_image_is_in_the_n_frame_of_its_moment(
    moments: list[tuple[bool, bool, int]],
) -> None:

    config = NFramesConfig(inputs=("left", "right"))
    left = [features(i * PERIOD_NS) for i, (has, _, _) in enumerate(moments) if has]
    right = [
        features(i * PERIOD_NS + late_ns, "right")
        for i, (_, has, late_ns) in enumerate(moments)
        if has
    ]

    async def run() -> list[NFrame]:
        sent = await run_operator(NFrames(config), config=config, left=left, right=right)
        return sent["n_frames"]

    made = anyio.run(run)

    assert [[f.frame for f in n.features] for n in made] == [
        [name for name, has in (("left", a), ("right", b)) if has] for a, b, _ in moments if a or b
    ]
    assert [f for n in made for f in n.features if f.frame == "left"] == left
    assert [f for n in made for f in n.features if f.frame == "right"] == right


async def test_A3_images_further_apart_than_the_tolerance_stay_apart_and_are_counted() -> None:
    config = NFramesConfig(inputs=("left", "right"))
    context = Context()
    sent = await run_operator(
        NFrames(config),
        config=config,
        run_context=context,
        left=[features(0)],
        right=[features(MS, "right")],
    )

    assert [n.stamp_ns for n in sent["n_frames"]] == [0, MS]
    assert context.activity.warnings == {
        "n-frames without right: none within 0.0005 s": 1,
        "n-frames without left: none within 0.0005 s": 1,
    }


async def test_a_slower_sensor_is_not_missed() -> None:
    config = NFramesConfig(inputs=("left", "lidar"), slower=("lidar",))
    context = Context()
    sent = await run_operator(
        NFrames(config),
        config=config,
        run_context=context,
        left=[features(0), features(PERIOD_NS), features(2 * PERIOD_NS)],
        lidar=[features(0, "lidar"), features(2 * PERIOD_NS, "lidar")],
    )

    assert [len(n.features) for n in sent["n_frames"]] == [2, 1, 2]
    assert context.activity.warnings == {}


def test_a_slower_sensor_is_an_input() -> None:
    with pytest.raises(ValidationError, match="no input radar; there are left"):
        NFramesConfig(inputs=("left",), slower=("radar",))


async def test_A14_keyframes_bring_features_into_the_map() -> None:
    stamps_ns = [i * PERIOD_NS for i in range(1, 41)]
    n_frames = [NFrame(stamp_ns=s, features=(features(s), features(s, "right"))) for s in stamps_ns]
    kept = await run_operator(
        Keyframes(KeyframesConfig(distance_m=0.4)),
        odometry=[odometry(s) for s in stamps_ns],
        n_frames=n_frames,
    )
    sent = await run_operator(SubmapBuilder(SubmapBuilderConfig()), keyframes=kept["keyframes"])
    map_ = Map.empty()
    for submap in sent["submaps"]:
        map_ = append_submap(map_, submap)

    assert check_map(map_) == []
    assert len(map_.vertices) == len(kept["keyframes"]) < len(stamps_ns)
    expected = [s % 97 for k in kept["keyframes"] for s in [k.stamp_ns] * 6]
    assert map_.observations.keypoint_px[:, 0].tolist() == expected
    assert map_.observations.track.tolist() == [0, 1, 2] * 2 * len(map_.vertices)


async def test_A14_a_trajectory_keeps_features_of_cameras_at_poses_of_any_odometry() -> None:
    config = TrajectoryConfig.model_validate(
        {"sources": {"odometry": {"kind": "odometry"}}, "n_frames": True, "period_s": 0.2}
    )
    stamps_ns = [7 * MS + i * PERIOD_NS for i in range(1, 60)]
    sent = await run_operator(
        Trajectory(config),
        config=config,
        odometry=[odometry(s * MS) for s in range(0, 3200, 33)],
        n_frames=[NFrame(stamp_ns=s, features=(features(s),)) for s in stamps_ns],
    )
    map_ = Map.empty()
    for submap in sent["submaps"]:
        map_ = append_submap(map_, submap)

    assert check_map(map_) == []
    assert map_.vertices.stamp_ns.tolist() == stamps_ns[::4]
    assert len(map_.observations) == 3 * len(map_.vertices)


async def test_G7_a_keyframe_is_kept_when_too_few_tracks_are_left() -> None:
    stamps_ns = [i * PERIOD_NS for i in range(1, 12)]

    def seen(number: int) -> NFrame:
        features_ = ImageFeatures(
            stamp_ns=stamps_ns[number],
            kind="klt",
            frame="left",
            keypoints_px=np.zeros((10, 2), np.float32),
            track_ids=np.arange(10) + number,
        )
        return NFrame(stamp_ns=stamps_ns[number], features=(features_,))

    config = KeyframesConfig(distance_m=100, rotation_rad=3, overlap=0.7)
    sent = await run_operator(
        Keyframes(config),
        odometry=[odometry(s) for s in stamps_ns],
        n_frames=[seen(n) for n in range(len(stamps_ns))],
    )

    kept = [stamps_ns.index(k.stamp_ns) for k in sent["keyframes"]]
    assert kept == [0, 4, 8, 10]  # with 6 of 10 tracks left; the last moment always


@pytest.mark.parametrize(("num_common", "expected"), [(0, 9), (-1, 0), (6, 0), (8, 9), (7, 3)])
async def test_C14_odometry_joins_poses_that_see_little_in_common(
    num_common: int, expected: int
) -> None:
    """Ten poses; six tracks are common to any two that follow, seven to six of the pairs."""
    stamps_ns = [i * PERIOD_NS for i in range(1, 11)]
    config = TrajectoryConfig.model_validate(
        {
            "sources": {"odometry": {"kind": "odometry"}},
            "imu": {},
            "n_frames": True,
            "period_s": 0.05,
            "num_common_tracks": num_common,
        }
    )
    first = [0, 3, 6, 9, 12, 15, 18, 22, 26, 30]  # of ten tracks in a row

    def seen(number: int) -> NFrame:
        features_ = ImageFeatures(
            stamp_ns=stamps_ns[number],
            kind="klt",
            frame="left",
            keypoints_px=np.zeros((10, 2), np.float32),
            track_ids=np.arange(10) + first[number],
        )
        return NFrame(stamp_ns=stamps_ns[number], features=(features_,))

    sent = await run_operator(
        Trajectory(config),
        config=config,
        odometry=[odometry(s * MS) for s in range(0, 700, 20)],
        imu=[imu(s * MS) for s in range(40, 720, 50)],
        n_frames=[seen(number) for number in range(10)],
    )
    map_ = Map.empty()
    for submap in sent["submaps"]:
        map_ = append_submap(map_, submap)

    assert check_map(map_) == []
    assert map_.edges.kind.tolist().count("imu") == 9
    assert map_.edges.kind.tolist().count("odometry") == expected
