"""The simulated detector of W-RGBD: boxes and masks of what is seen, the errors that are asked for, and the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.w_rgbd import T_BASE_CAMERA, WRgbdConfig, rgbd_world, w_rgbd
from mapstream.streams.camera_models import project
from mapstream.streams.messages.objects import ObjectDetections

pytestmark = pytest.mark.anyio

SMALL: dict[str, Any] = {
    "duration_s": 4.0,
    "camera": {"width_px": 160, "height_px": 120, "rate_hz": 2.0},
    "texel_m": 0.1,
}
PERFECT: dict[str, Any] = {
    "missed": 0,
    "wrong_class": 0,
    "duplicates": 0,
    "false_per_image": 0,
    "box_noise_px": 0,
    "mask_noise_px": 0,
    "min_pixels": 12,
}


def pairs(
    objects: dict[str, Any], world: dict[str, Any] | None = None
) -> list[tuple[ObjectDetections, ObjectDetections]]:
    """Return the detections in each image, and their truth."""
    config = WRgbdConfig.model_validate(SMALL | (world or {}) | {"objects": objects})
    by_topic: dict[str, list[Any]] = {"/color/objects": [], "/truth/objects": []}
    for record in w_rgbd(config, 0).records:
        by_topic.get(record.topic, []).append(record.message)
    return list(zip(*by_topic.values(), strict=True))


def test_a_perfect_detector_says_the_truth() -> None:
    """Its boxes hold the middle of things, its masks are what is seen of them, and nothing else."""
    world = rgbd_world(WRgbdConfig.model_validate(SMALL), 0)
    lens = WRgbdConfig.model_validate(SMALL).camera.calibration("color")
    labels: set[str] = set()
    for found, truth in pairs(PERFECT):
        assert found.labels == truth.labels == truth.texts  # one thing of each class
        np.testing.assert_array_equal(found.boxes_px, truth.boxes_px)
        assert truth.centers_m is not None
        assert truth.extents_m is not None
        pixels, _ = project(lens, truth.centers_m.astype(np.float64))
        inside = (pixels > found.boxes_px[:, :2]) & (pixels < found.boxes_px[:, 2:])
        assert inside.all()
        at_once = np.zeros((found.height_px, found.width_px), np.int64)
        for row in range(len(found)):
            assert found.full_mask(row).sum() >= PERFECT["min_pixels"]
            at_once += found.full_mask(row)
        assert at_once.max() <= 1  # things hide each other
        labels.update(found.labels)
    assert labels == {thing.label for thing in world.room.things}


@pytest.mark.slow
def test_what_is_asked_for_goes_wrong() -> None:
    asked = {"missed": 0.3, "wrong_class": 0.2, "duplicates": 0.3, "false_per_image": 2.0}
    found = pairs(PERFECT | asked, {"camera": SMALL["camera"] | {"rate_hz": 20.0}})
    num = sum(len(d) for d, _ in found)
    in_view = sum(len({*truth.texts} - {""}) for _, truth in found)
    num_false = sum(truth.texts[: len(d)].count("") for d, truth in found)
    num_twice = sum(len(d) - len({*truth.texts[: len(d)]} - {""}) for d, truth in found)
    wrong = [
        said != true
        for d, truth in found
        for said, true in zip(d.labels, truth.labels[: len(d)], strict=True)
        if true
    ]

    assert sum(len(t) - len(d) for d, t in found) / in_view == pytest.approx(0.3, abs=0.08)
    assert num_false / len(found) == pytest.approx(2.0, abs=0.4)
    assert np.mean(wrong) == pytest.approx(0.2, abs=0.06)
    assert (num_twice - num_false) / (num - num_false) == pytest.approx(0.3 / 1.3, abs=0.08)


def test_people_are_seen_and_hide_what_is_behind_them() -> None:
    found = [truth for _, truth in pairs(PERFECT, {"people": 2})]
    names = {name for truth in found for name in truth.texts}
    assert {"person.0", "person.1"} <= names
    assert {label for t in found for label in t.labels if label.startswith("person")} == {"person"}


def test_masks_are_left_out_where_nobody_wants_them() -> None:
    assert all(not found.masks for found, _ in pairs(PERFECT | {"masks": False}))


async def test_the_same_seed_sees_the_same_and_a_source_gives_place_and_camera(
    tmp_path: Path,
) -> None:
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    for path, seed in zip(paths, (3, 3), strict=True):
        simulate("w_rgbd", path, seed=seed, **SMALL, objects={})
    assert paths[0].read_bytes() == paths[1].read_bytes()

    config = McapSourceConfig(path=paths[0], topics={"detections": "/color/objects"})
    detections = (await run_operator(McapSource(config), config=config))["detections"]
    assert all(isinstance(each, ObjectDetections) and each.camera for each in detections)
    assert all(each.camera.width_px == each.width_px for each in detections)
    np.testing.assert_allclose(detections[0].T_base_sensor.matrix, T_BASE_CAMERA.matrix)
