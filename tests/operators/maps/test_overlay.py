"""The map over a picture agrees with what the camera saw."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from mapstream.operators.maps.overlay import overlay
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Landmarks
from mapstream.streams.geometry import SE3
from tests.operators.maps.test_colmap import seen_map


def test_P6_landmarks_lie_where_they_were_seen() -> None:
    map_ = seen_map()
    seen = map_.observations

    for name, camera in cameras_of(map_, 0).items():
        for vertex in range(4):
            shown = overlay(map_, camera, SE3(map_.T_map_base(np.array([vertex]))[0]))
            rows = np.flatnonzero((seen.vertex == vertex) & (seen.sensor == name))
            px = dict(zip(seen.landmark[rows].tolist(), seen.keypoint_px[rows], strict=True))
            expected = np.array([px[landmark] for landmark in shown.landmarks.tolist()])
            assert len(shown.landmarks) > 5
            np.testing.assert_allclose(shown.points_px, expected, atol=1e-3)


def test_P6_the_outline_of_a_plane_is_cut_where_the_image_ends() -> None:
    map_ = seen_map({"left": ("none", [])})
    camera = cameras_of(map_, 0)["left"]
    T_base_wall = camera.T_base_sensor @ SE3.exp([0, 0, 0, 0, 0, 10.0])
    hull = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
    wide = [[-20.0, -1.0], [20.0, -1.0], [20.0, 1.0], [-20.0, 1.0]]
    planes = Landmarks(
        id=id_array(derived_id("plane", n) for n in range(2)),
        kind=np.array(["plane", "plane"], dtype=object),
        label=np.array(["picture", "wall"], dtype=object),
        vertex=np.zeros(2, np.int64),
        p_base=np.tile(T_base_wall.t, (2, 1)),
        quat_base_xyzw=np.tile(T_base_wall.quat_xyzw, (2, 1)),
        payload=np.array([json.dumps({"hull": h}).encode() for h in (hull, wide)], dtype=object),
    )
    map_ = replace(map_, landmarks=concatenate([map_.landmarks, planes]))

    shown = overlay(map_, camera, SE3(map_.T_map_base(np.array([0]))[0]))

    assert shown.outline_labels == ("picture", "wall", "wall")
    low, high = shown.outlines_px[0].min(axis=0), shown.outlines_px[0].max(axis=0)
    np.testing.assert_allclose([low, high], [[280, 199.9], [360, 280.1]], atol=1e-6)
    assert all(np.abs(line[:, 0] - 319.5).max() <= 320 for line in shown.outlines_px)
