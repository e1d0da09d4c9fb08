"""The map over the live image lies where the camera sees what is in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.images.map_overlay import MapOverlay, MapOverlayConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import save_map
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.maps.test_colmap import seen_map

pytestmark = pytest.mark.anyio


async def test_P6_landmarks_are_drawn_within_two_pixels_of_where_they_are_seen(
    tmp_path: Path,
) -> None:
    map_ = seen_map()
    labels = np.array(["cup"] + [""] * (len(map_.landmarks) - 1), dtype=object)
    save_map(replace(map_, landmarks=replace(map_.landmarks, label=labels)), tmp_path / "map")
    camera = cameras_of(map_, 0)["rear"]
    frames, poses = [], []
    for stamp_ns, T_map_base in zip((1, 2, 3), map_.T_map_base(np.arange(3)), strict=True):
        image = np.zeros((480, 640), np.uint8)
        frame = CameraFrame(stamp_ns=stamp_ns * 10**9, image=image, encoding="mono8", frame="rear")
        frames.append(replace(frame, camera=camera.calibration, T_base_sensor=camera.T_base_sensor))
        is_lost = stamp_ns == 3
        poses.append(
            MapPose(
                stamp_ns=stamp_ns * 10**9,
                state="lost" if is_lost else "tracking",
                T_map_base=None if is_lost else SE3(T_map_base),
            )
        )
    context = Context()
    config = MapOverlayConfig(map=tmp_path / "map")

    sent = await run_operator(MapOverlay(config), run_context=context, frames=frames, poses=poses)

    seen = map_.observations
    for vertex, made in enumerate(sent["frames"][:2]):
        assert made.encoding == "bgr8"
        marks = np.argwhere((made.image == (176, 255, 61)).all(axis=2))[:, ::-1]
        rows = np.flatnonzero((seen.vertex == vertex) & (seen.sensor == "rear"))
        px = seen.keypoint_px[rows]
        px = px[((px >= 3) & (px < [637, 477])).all(axis=1)]
        nearest = np.linalg.norm(px[:, None] - marks, axis=2).min(axis=1)
        assert len(px) > 5
        assert nearest.max() < 1.0
        spread = np.linalg.norm(marks[:, None] - seen.keypoint_px[rows], axis=2).min(axis=1)
        assert spread.max() < 3.0  # nothing else is drawn in that colour; dots have a radius of 2
    assert (sent["frames"][2].image == 0).all()
    assert context.activity.warnings == {"images of a time at which the robot is not localised": 1}
