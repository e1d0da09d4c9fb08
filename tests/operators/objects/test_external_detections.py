"""Objects of other programs are checked, completed and let in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.objects.external_detections import (
    ExternalDetections,
    ExternalDetectionsConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.diagnosis import diagnose
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor
from tests.recordings.decoding.made_vision import Thing, detections

pytestmark = pytest.mark.anyio

CAMERA = CameraCalibration(
    frame="left",
    width_px=64,
    height_px=48,
    focal_px=np.array([40.0, 40.0]),
    center_px=np.array([31.5, 23.5]),
    distortion_parameters=np.empty(0),
)


def objects(*boxes_px: tuple[float, float, float, float], **more: Any) -> ObjectDetections:  # noqa: ANN401  # of any field
    """Return cups in an image of 64 x 48 px."""
    fields: dict[str, Any] = {
        "stamp_ns": 5,
        "frame": "left",
        "width_px": 64,
        "height_px": 48,
        "boxes_px": np.array(boxes_px, np.float32).reshape(-1, 4),
        "labels": ("cup",) * len(boxes_px),
        "scores": np.full(len(boxes_px), 0.5, np.float32),
    }
    return ObjectDetections(**(fields | more))


async def let_in(
    message: ObjectDetections, context: Context | None = None, **options: object
) -> list[ObjectDetections]:
    operator = ExternalDetections(ExternalDetectionsConfig.model_validate(options))
    return (await run_operator(operator, run_context=context, detections=[message]))["detections"]


async def test_what_is_whole_passes_as_it_is() -> None:
    box = (3.5, 2.5, 9.5, 8.5)
    mask = np.eye(6, dtype=bool)
    given = objects(box, masks=(mask,), mask_sources=("depth",), track_ids=np.array([4]))

    (found,) = await let_in(given)

    np.testing.assert_array_equal(found.boxes_px, [box])
    np.testing.assert_array_equal(found.masks[0], mask)
    assert (found.mask_sources, found.stamp_ns) == (("depth",), 5)
    np.testing.assert_array_equal(found.track_ids, [4])


async def test_what_cannot_be_used_is_left_out_and_counted() -> None:
    good = (3.5, 2.5, 9.5, 8.5)
    boxes = [
        good,
        (np.nan, 1, 2, 3),
        (9, 9, 9, 12),
        (70, 1, 80, 9),
        good,
        good,
        good,
        (-9, -9, 9, 9),
    ]
    message = objects(
        *boxes,
        labels=("cup",) * 4 + ("", "cup", "cup", "cup"),
        scores=np.array([0.5] * 5 + [1.5, np.nan, 1.0], np.float32),
        track_ids=np.array([4, 5, 6, -1, -1, -1, -1, 4]),
    )
    context = Context()

    (found,) = await let_in(message, context)

    np.testing.assert_array_equal(found.boxes_px, [good])
    assert context.activity.losses == {
        "objects of left: the score is not between 0 and 1": 2,
        "objects of left: no class": 1,
        "objects of left: neither a box in the image nor one in space before the camera": 1,
        "objects of left: the box has no area": 1,
        "objects of left: the box is outside of the image": 1,
        "objects of left: a track id comes twice in one image; it names one object": 1,
    }


async def test_boxes_end_with_the_image_and_masks_with_pixels_are_kept() -> None:
    mask = np.zeros((6, 6), bool)
    message = objects((-9, -9, 9, 9), (3.5, 2.5, 9.5, 8.5), masks=(np.ones((10, 10), bool), mask))
    context = Context()

    (found,) = await let_in(message, context)

    np.testing.assert_array_equal(found.boxes_px[0], [-0.5, -0.5, 9, 9])
    assert found.masks[1].all()
    assert found.mask_sources == ("model", "box")
    assert list(context.activity.warnings.values()) == [1]


async def test_numbers_become_names(tmp_path: Path) -> None:
    names = tmp_path / "names.txt"
    names.write_text("person\ncup\n")
    box = (3.5, 2.5, 9.5, 8.5)
    message = objects(box, box, box, box, labels=("1", "0", "chair", "2"))
    context = Context()

    (found,) = await let_in(message, context, class_names=names)
    (cups,) = await let_in(message, class_names=names, classes=("cup",))

    assert found.labels == ("cup", "person", "chair", "2")
    assert list(context.activity.warnings) == ["objects of class 2, which is not among the 2 names"]
    assert cups.labels == ("cup",)
    with pytest.raises(ConfigError, match=r"none\.txt: expected names of classes"):
        await let_in(message, class_names=tmp_path / "none.txt")


async def test_images_of_unknown_or_of_two_sizes_lose_their_objects() -> None:
    message = objects((3.5, 2.5, 9.5, 8.5))
    context = Context()

    unknown = await let_in(replace(message, width_px=0, height_px=0), context)
    other = await let_in(replace(message, width_px=640, camera=CAMERA), context)

    assert unknown + other == []
    reasons = " ".join(context.activity.losses)
    assert "nobody says how large the images of left are" in reasons


async def test_objects_in_space_get_the_box_in_which_their_camera_sees_them() -> None:
    nan = (np.nan,) * 4
    message = objects(
        nan,
        nan,
        nan,
        width_px=0,
        height_px=0,
        camera=CAMERA,
        centers_m=np.array([[0, 0, 2], [0, 0, -2], [0.2, 0, 2]]),
        extents_m=np.array([[0.8, 0.2, 0.4], [0.8, 0.2, 0.4], [np.nan] * 3]),
        quats_camera_object_xyzw=np.array([[0, 0, np.sqrt(0.5), np.sqrt(0.5)]] * 3),
    )
    context = Context()

    (found,) = await let_in(message, context)

    # turned by 90 degrees: 0.2 m wide and 0.8 m high, its near side 1.8 m away
    half = np.array([0.1, 0.4]) * 40 / 1.8
    expected = np.concatenate([CAMERA.center_px - half, CAMERA.center_px + half])
    np.testing.assert_allclose(found.boxes_px, [expected], atol=1e-4)
    assert (found.width_px, found.height_px) == (64, 48)
    assert list(context.activity.losses.values()) == [2]


async def test_vision_msgs_of_a_recording_are_let_in(tmp_path: Path) -> None:
    """The sensor file tells the camera, and so the size of the image that the messages do not tell."""
    path = tmp_path / "objects.mcap"
    raw = detections("cdr", "2D", [Thing((("cup", 0.9),), (10.0, 20.0, 0.0, 6.0, 8.0), track="3")])
    camera = CameraSensor(
        id="0" * 32, topic="/left/image", description="", frame="left", calibration=CAMERA
    )
    place = Extrinsics(sensor_id=camera.id, base_sensor_id=camera.id, T_base_sensor=SE3.identity())
    with McapWriter(path) as writer:
        attach_rig(writer, Rig([camera], [place]))
        writer.write_raw(raw.channel, raw.data, raw.log_ns)
    config = McapSourceConfig.model_validate({"path": path, "topics": {"detections": "/objects"}})
    (recorded,) = (await run_operator(McapSource(config), config=config))["detections"]

    (found,) = await let_in(recorded)

    assert (found.labels, found.width_px, found.height_px) == (("cup",), 64, 48)
    np.testing.assert_array_equal(found.boxes_px, [[6.5, 15.5, 12.5, 23.5]])
    assert found.camera is not None


def test_the_doctor_gives_the_same_reasons(tmp_path: Path) -> None:
    path = tmp_path / "objects.mcap"
    with McapWriter(path) as writer:
        for stamp_ns in (10**9, 2 * 10**9):
            writer.write("/objects", objects((9, 9, 9, 12), labels=("",), stamp_ns=stamp_ns))

    with open_recording(path) as recording:
        texts = [finding.text for finding in diagnose(recording).findings]

    assert "2 messages: no class; the first at 1000000000 ns" in texts
    assert "2 messages: the box has no area; the first at 1000000000 ns" in texts
