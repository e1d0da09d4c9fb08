"""World W-PAN: repeatable, and only its transforms say where the camera sits."""

from pathlib import Path
from typing import Any

import numpy as np

from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.w_pan import WPanConfig, w_pan
from mapstream.streams.messages.sensors import LidarScan

SMALL: dict[str, Any] = {"duration_s": 0.5, "camera": {"columns": 8, "rows": 6}}


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (3, 3, 4), strict=True):
        simulate("w_pan", path, seed=seed, **SMALL)

    a, b, c = (path.read_bytes() for path in paths)
    assert a == b
    assert a != c
    with McapRecording(paths[0]) as recording:
        assert set(recording.topics) == {"/points", "/tf", "/tf_static", "/truth"}


def test_A19_clouds_carry_no_place_of_their_own() -> None:
    records = w_pan(WPanConfig.model_validate(SMALL), 0).records
    clouds = [record.message for record in records if isinstance(record.message, LidarScan)]

    assert len(clouds) == 6
    assert all(np.array_equal(cloud.T_base_sensor.matrix, np.eye(4)) for cloud in clouds)
    assert {cloud.frame for cloud in clouds} == {"depth"}
